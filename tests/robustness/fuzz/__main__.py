"""Look for inputs that a parser does not survive.

Run: `python -m tests.robustness.fuzz PARSER --seconds 60`.

With atheris (requirements-fuzz.lock, Apache-2.0) it is guided by coverage, without it inputs
are mutated blindly. A crash is printed with the input as hexadecimal, and the exit status is 1.
`--save` adds what reached new code to the committed corpus, minimised. `--quiet-minutes 30` goes
round the parsers in pieces of `--seconds`, until each has run so many CPU minutes without a new
edge; it can be ended at any time and goes on where it was, by the record in the folder `--work`.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import random
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.robustness.fuzz import corpus
from tests.robustness.fuzz.progress import Piece, begun, piece_of, until_quiet
from tests.robustness.fuzz.target import INPUT_MAX_S, INPUT_MAX_SIZE
from tests.robustness.fuzz.targets import TARGETS

CRASH_STATUS = 77


def main() -> int:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("parser", choices=[*TARGETS, "all"])
    arguments.add_argument("--seconds", type=float, default=60.0)
    arguments.add_argument("--save", action="store_true")
    arguments.add_argument("--work", type=Path, help="Where inputs are kept between runs.")
    arguments.add_argument(
        "--quiet-minutes", type=float,
        help="CPU minutes without a new edge after which a parser is done (needs --work).",
    )  # fmt: skip
    arguments.add_argument("--guided", help=argparse.SUPPRESS)
    given, rest = arguments.parse_known_args()
    if given.guided is not None:
        return guided(given.parser, given.guided, rest)
    names = list(TARGETS) if given.parser == "all" else [given.parser]
    if given.quiet_minutes is not None:
        if given.work is None:
            arguments.error("--quiet-minutes needs --work FOLDER, where inputs and record are kept")
        return until_quiet(names, given.work, given.quiet_minutes * 60.0, _piece_of(given))
    failed = [name for name in names if not _fuzz(name, given)]
    print(f"{len(names) - len(failed)} of {len(names)} without a crash", *failed)
    return 1 if failed else 0


def _fuzz(name: str, given: argparse.Namespace) -> bool:
    if importlib.util.find_spec("atheris") is None:
        return blind(name, given.seconds)
    work = given.work or Path(tempfile.mkdtemp(prefix="fuzz-"))
    piece = guided_piece(name, work, given.seconds)
    if not piece.is_well:
        return False
    if given.save:
        merged = work / f"{name}.merged"
        shutil.rmtree(merged, ignore_errors=True)
        merged.mkdir()
        subprocess.run(
            [str(work / f"{name}.sh"), *_limits(name), "-merge=1", str(merged), str(work / name)],
            capture_output=True, check=True,
        )  # fmt: skip
        corpus.write(name, [path.read_bytes() for path in merged.iterdir()])
    return True


def _piece_of(given: argparse.Namespace) -> Callable[[str], Piece]:
    if importlib.util.find_spec("atheris") is None:
        raise SystemExit(
            "edges are counted by atheris: pip install --require-hashes -r requirements-fuzz.lock"
        )
    return lambda name: guided_piece(name, given.work, given.seconds)


def _limits(name: str) -> list[str]:
    longest = max(INPUT_MAX_SIZE, *map(len, TARGETS[name]().seeds))
    return [f"-max_len={longest}", "-rss_limit_mb=2048", "-timeout=30", "-verbosity=1"]


def guided_piece(name: str, work: Path, seconds: float) -> Piece:
    """Fuzz one parser for a while, with the inputs that earlier pieces left."""
    inputs = work / name
    inputs.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate((*corpus.read(name), *TARGETS[name]().seeds)):
        (inputs / f"seed-{number}").write_bytes(data)
    command = work.resolve() / f"{name}.sh"  # libFuzzer starts itself again to minimise
    line = shlex.join(
        [sys.executable, "-m", "tests.robustness.fuzz", name, "--guided", str(command)]
    )
    command.write_text(f'#!/bin/sh\nexec {line} "$@"\n')
    command.chmod(0o700)
    found = [f"-artifact_prefix={inputs}/", f"-max_total_time={seconds:.0f}"]
    memory = Path("/dev/shm")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as place:
        done = subprocess.run(
            [str(command), *_limits(name), *found, str(inputs)],
            capture_output=True, text=True, check=False, env={**os.environ, "TMPDIR": place},
        )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    crashes = [path for kind in ("crash", "timeout", "oom") for path in inputs.glob(f"{kind}-*")]
    stderr_lines = done.stderr.splitlines()
    print(
        name, *[line for line in stderr_lines if "DONE" in line or "Done " in line][-2:], sep="  "
    )
    is_well = not crashes and not done.returncode
    if not is_well:
        print(
            f"{name}: status {done.returncode}\n"
            + "\n".join((done.stdout.splitlines() + stderr_lines)[-25:])
        )
        for path in crashes:
            print(f"{name}: {path}: {path.read_bytes()[:2000].hex()}")
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return piece_of(done.stderr, spent_s, is_well=is_well)


def guided(name: str, command: str, options: list[str]) -> int:
    """Within a process of its own, started by `command`: libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=["daemon", "drivers", "processing", "tomllib"]):
        target = TARGETS[name]()
        for seed in target.seeds:
            target.run(seed)

    def one(data: bytes) -> None:
        begun_s = time.process_time()
        target.run(data)
        if (took_s := time.process_time() - begun_s) > INPUT_MAX_S:
            raise TimeoutError(f"{took_s:.1f} s of CPU")

    print(begun(time.process_time()), file=sys.stderr, flush=True)
    atheris.Setup([command, *options], one)
    atheris.Fuzz()
    return 0


def blind(name: str, seconds: float) -> bool:
    """Mutate without a guide."""
    target = TARGETS[name]()
    ends_s = time.monotonic() + seconds
    count = 0
    for data in mutations((*corpus.read(name), *target.seeds), random.Random(0)):
        count += 1
        begun_s = time.process_time()
        try:
            target.run(data)
        except Exception as error:  # noqa: BLE001 - this is what is looked for
            print(f"{name}: {type(error).__name__}: {error}\n{data.hex()}")
            return False
        if time.process_time() - begun_s > INPUT_MAX_S:
            print(f"{name}: more than {INPUT_MAX_S} s\n{data.hex()}")
            return False
        if time.monotonic() > ends_s:
            break
    print(f"{name}  {count} inputs, not guided")
    return True


def mutations(seeds: tuple[bytes, ...], rng: random.Random) -> Iterator[bytes]:
    """Spoilt seeds, without end."""
    tokens = [b"\xff" * 4, b"\0" * 4, b"\xff" * 8, b"\x7f", *b'1e999 -1 NaN " [ {'.split()]
    while True:
        data = bytearray(rng.choice(seeds))
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(data) + 1)
            kind = rng.randrange(5)
            if kind == 0:
                del data[at : at + rng.randint(1, 16)]
            elif kind == 1:
                data[at:at] = rng.choice(tokens)
            elif kind == 2:
                data[at : at + 4] = rng.choice(tokens)
            elif kind == 3:
                other = rng.choice(seeds)
                data[at:] = other[rng.randrange(len(other) + 1) :]
            else:
                data[at : at + 1] = bytes([rng.randrange(256)])
        yield bytes(data[:INPUT_MAX_SIZE])


if __name__ == "__main__":
    sys.exit(main())
