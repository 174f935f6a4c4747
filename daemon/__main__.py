"""`python -m daemon`: the command `syntopic`, for callers that know only the interpreter."""

from daemon.cli import main

if __name__ == "__main__":
    main()
