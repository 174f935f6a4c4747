"""Run the tests that need real time several times, with busy loops next to them.

    python -m tests.support.busy [--runs 5] [--loops 4] [PYTEST ARGUMENT ...]

Stops at the first run that fails. A line with the result is added to `tests/busy.md`.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = Path(__file__).parents[1] / "busy.md"
LOOP: Final = (sys.executable, "-c", "while True: pass")
MARK: Final = "realtime"
FLIGHTS: Final = "tests/system"
UNTIMED: Final = tuple(f"--ignore={FLIGHTS}/{name}.py" for name in ("test_replay", "test_wheel"))
"""What takes recorded times, or installs; part of the whole run."""
# As `make test` runs them, at the priority of the loops.
WORKERS: Final = ("-n", "3", "--dist", "loadfile", "--no-loadscope-reorder")
PRIORITY: Final = {"SYNTOPIC_TEST_NICENESS": "0"}


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """So many processes that compute without end."""
    loops = [subprocess.Popen(LOOP) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait(10)


def real_time_tests() -> list[str]:
    """Arguments that select them; only files that name the mark are collected."""
    files = [
        str(path.relative_to(ROOT))
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if MARK in path.read_text(encoding="utf-8") and FLIGHTS not in path.as_posix()
    ]
    return ["-m", f"{MARK} and not soak", *UNTIMED, FLIGHTS, *files]


def run_once(arguments: Sequence[str]) -> tuple[int, str]:
    """Exit status and the line in which pytest counts its tests; the output is passed on."""
    command = [sys.executable, "-m", "pytest", *WORKERS, *arguments]
    last = ""
    environment = os.environ | PRIORITY
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            if re.search(r"\d+ (passed|failed)", line):
                last = line.strip().strip("= ")
    return process.returncode, last


def main(arguments: Sequence[str]) -> int:
    """The exit status: 0 where all runs passed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--loops", type=int, default=4)
    options, selected = parser.parse_known_args(arguments)
    results = []
    load = os.getloadavg()[0]
    with busy_loops(options.loops):
        for _ in range(options.runs):
            begun_s = time.monotonic()
            status, summary = run_once(selected or real_time_tests())
            minutes = (time.monotonic() - begun_s) / 60
            results.append(f"{summary} ({minutes:.0f} min)")
            if status != 0:
                break
    commit = subprocess.run(
        ["git", "rev-parse", "--short=10", "HEAD"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    what = " ".join(selected) or "all that need real time"
    row = (
        f"| {datetime.now(UTC):%Y-%m-%d}, {commit} | {what} "
        f"| {options.loops} | {os.cpu_count()} | {load:.1f} to {os.getloadavg()[0]:.1f} "
        f"| {'; '.join(results)} |\n"
    )
    with PAGE.open("a", encoding="utf-8") as page:
        page.write(row)
    print(row)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
