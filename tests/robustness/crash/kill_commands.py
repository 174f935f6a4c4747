"""Commands killed at random system calls.

Run: `python -m tests.robustness.crash.kill_commands FOLDER KILLS SEED`.

`transfer`, `process`, `report` and `repair` run in children of this process, which has imported
what they need. strace kills a child at a call chosen at random among those that its command makes,
SQLite's among them, up to three times in a row; then the command runs to its end. After each kill
all captured data must exist, unaltered, in a complete copy.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field
from io import StringIO
from pathlib import Path

from daemon import cli
from daemon.cli import process, repair, report  # noqa: F401 - the children need not import them
from daemon.mission.layout import Mission
from daemon.mission.store import durable
from daemon.mission.transfer.transfer_removal import removing_path
from daemon.mission.verification.verification import verify
from daemon.onboard.pipeline import worker  # noqa: F401
from daemon.products import processor  # noqa: F401
from tests.daemon.diverging_camera import flown_mission
from tests.robustness.crash.kill_transfer import content_of
from tests.robustness.crash.write_log import STRACE

COMMANDS = ("transfer", "process", "report", "repair")
CALLS = (
    "openat,write,writev,pwrite64,fsync,fdatasync,ftruncate,fallocate,mkdir,mkdirat,rename,"
    "renameat,renameat2,unlink,unlinkat,rmdir,link,fchmod,utimensat,flock"
)
MAX_IN_A_ROW = 3
LIMIT_S = 240.0
PRODUCTS = {"LEFT.tif", "RIGHT.tif", "quality.json", "quicklook.jpg", "thumbnail.jpg"}

Call = tuple[str, int]
"""A system call, and the how many-th of its thread it is."""


@dataclass
class Figures:
    """What was done, and what was found."""

    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COMMANDS, 0))
    ended_before: int = 0
    rounds: int = 0
    calls: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    wrong: list[str] = field(default_factory=list)

    @property
    def all_kills(self) -> int:
        return sum(self.kills.values())


class CommandBench:
    """A mission below `folder`, as before a command, and what of it must never be lost."""

    def __init__(self, folder: Path) -> None:
        self._original = flown_mission(folder / "pristine", (1, 2, 3)).path
        self._work_folder = folder / "trial"
        self.mission = self._work_folder / "flown" / self._original.name
        self.disk = self._work_folder / "disk"
        self.output_file = folder / "output.txt"
        self._run_on_original("process")
        self._run_on_original("report")
        self.captured = _captured(self._original)
        self.all = content_of(self._original)

    def arguments(self, command: str) -> list[str]:
        """The command line."""
        options = {
            "transfer": [str(self.disk), "--remove-source"],
            "process": ["--threads", "1", "--processes", "0", "--again"],
            "repair": ["--rebuild"],
        }
        return [command, str(self.mission), *options.get(command, [])]

    def begin(self, command: str) -> None:
        """The mission as before the command."""
        shutil.rmtree(self._work_folder, ignore_errors=True)
        self.disk.mkdir(parents=True)
        shutil.copytree(self._original, self.mission)
        if command == "repair":  # what a crash left
            part = self.mission / f"L0/000004{durable.PART_SUFFIX}"
            part.mkdir()
            (part / "LEFT.tif").write_bytes(b"half")

    def check_interrupted(self, command: str) -> None:
        """What holds at any instant."""
        if command == "transfer":
            target = self.disk / self.mission.name
            source_is_there = self.mission.exists()
            copies = [self.mission] if source_is_there else [target]
            assert all(self._is_complete(copy) for copy in copies), "no complete copy is left"
            return
        assert _captured(self.mission) == self.captured, "captured data changed"
        page = self.mission / "export/report.html"
        assert page.read_bytes().rstrip().endswith(b"</html>"), "the report is cut"
        for folder in (self.mission / "L2").glob("[0-9]" * 6):
            names = {path.name for path in folder.iterdir()}
            assert names >= PRODUCTS, f"half products: {folder.name} {sorted(names)}"
            assert all(path.stat().st_size for path in folder.iterdir()), "an empty product"

    def check_finished(self, command: str) -> None:
        """What holds after a run that came to its end."""
        self.check_interrupted(command)
        place = self.disk / self.mission.name if command == "transfer" else self.mission
        problems = verify(Mission.open(place)).problems
        assert problems == (), problems
        assert sorted(p.name for p in (place / "L2").iterdir()) == ["000001", "000002", "000003"]
        left = [str(p) for p in self._work_folder.rglob("*.part") if ".discarded" not in p.parts]
        assert left == [], left
        if command == "transfer":
            assert not self.mission.exists() and not removing_path(self.mission).exists()

    def _is_complete(self, folder: Path) -> bool:
        content = {n: s for n, s in content_of(folder).items() if not n.endswith(".part")}
        return content == self.all and verify(Mission.open(folder)).is_intact

    def _run_on_original(self, command: str) -> None:
        status = _status(
            _started([*self.arguments(command)[:1], str(self._original)], self.output_file)
        )
        assert status == 0, self.output_file.read_text()


def _captured(mission: Path) -> dict[str, str]:
    """SHA-256 of frames, records, logs and configuration."""
    return {
        name: sha256
        for name, sha256 in content_of(mission).items()
        if (name.startswith("L0/0") and ".part/" not in name)
        or name.endswith((".mcap", ".toml"))
        or name == "mission.json"
    }


@dataclass(frozen=True)
class _Child:
    pid: int
    go: int


def _started(arguments: Sequence[str], output_file: Path) -> _Child:
    """A child that runs a command as soon as it may."""
    waits, go = os.pipe()
    child = os.fork()
    if child:
        os.close(waits)
        return _Child(child, go)
    os.close(go)
    os.read(waits, 1)
    sys.argv = ["syntopic", *arguments]
    output = StringIO()
    status: object = 1
    try:
        with redirect_stdout(output), redirect_stderr(output):
            cli.main()
    except SystemExit as ended:
        status = ended.code
    except BaseException as error:  # noqa: BLE001 - a traceback is a finding
        output.write(repr(error))
    output_file.write_text(output.getvalue())
    os._exit(status if isinstance(status, int) else 1)


def _status(child: _Child) -> int:
    """Let a child run to its end; its exit status, or the number of its signal, negative."""
    os.write(child.go, b"1")
    os.close(child.go)
    until_s = time.monotonic() + LIMIT_S
    while time.monotonic() < until_s:
        pid, status = os.waitpid(child.pid, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(child.pid, 9)
    os.waitpid(child.pid, 0)
    raise AssertionError(f"a command hung for {LIMIT_S:g} s")


def _traced(child: _Child, options: Sequence[str]) -> int:
    """As `_status`, below strace."""
    assert STRACE is not None
    tracer = subprocess.Popen(
        [STRACE, "-f", "-qq", *options, "-p", str(child.pid)], stderr=subprocess.DEVNULL
    )
    status = Path(f"/proc/{child.pid}/status")
    until_s = time.monotonic() + LIMIT_S
    while "TracerPid:\t0\n" in status.read_text():
        assert tracer.poll() is None and time.monotonic() < until_s, "strace does not attach"
        time.sleep(0.001)
    try:
        return _status(child)
    finally:
        tracer.wait(LIMIT_S)


def calls_of(bench: CommandBench, command: str, log: Path) -> list[Call]:
    """The calls that a command makes when nobody interrupts it."""
    bench.begin(command)
    child = _started(bench.arguments(command), bench.output_file)
    status = _traced(child, ["-o", str(log), "-e", f"trace={CALLS}"])
    assert status == 0, bench.output_file.read_text()
    counts: Counter[tuple[str, str]] = Counter()
    calls = []
    for line in log.read_text().splitlines():
        found = re.match(r"(\d+) +(\w+)\(", line)
        if found:
            counts[found[1], found[2]] += 1
            calls.append((found[2], counts[found[1], found[2]]))
    return calls


def kill(folder: Path, kills: int, seed: int) -> Figures:
    """Kill so often; findings are in `wrong`."""
    begun_s = time.monotonic()
    figures = Figures()
    bench = CommandBench(folder)
    calls = {command: calls_of(bench, command, folder / "trace") for command in COMMANDS}
    figures.calls = {command: len(made_calls) for command, made_calls in calls.items()}
    rng = random.Random(seed)
    while figures.all_kills < kills:
        command = COMMANDS[figures.rounds % len(COMMANDS)]
        figures.rounds += 1
        chosen = [rng.choice(calls[command]) for _ in range(rng.randint(1, MAX_IN_A_ROW))]
        try:
            _round(bench, command, chosen, figures)
        except Exception as error:  # noqa: BLE001 - whatever a check raises is a finding
            figures.wrong.append(f"{command} {chosen}: {type(error).__name__}: {error}")
            if len(figures.wrong) >= 10:
                break
    figures.seconds = round(time.monotonic() - begun_s, 1)
    return figures


def _round(bench: CommandBench, command: str, chosen: Sequence[Call], figures: Figures) -> None:
    bench.begin(command)
    for name, number in chosen:
        child = _started(bench.arguments(command), bench.output_file)
        inject = f"inject={name}:signal=KILL:when={number}"
        status = _traced(child, ["-o", "/dev/null", "-e", f"trace={name}", "-e", inject])
        if status == -9:
            figures.kills[command] += 1
        else:  # a later run makes fewer calls than the first
            assert status == 0, bench.output_file.read_text()
            figures.ended_before += 1
        bench.check_interrupted(command)
    status = _status(_started(bench.arguments(command), bench.output_file))
    assert status == 0, bench.output_file.read_text()
    bench.check_finished(command)


def main() -> None:
    figures = kill(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
    print(json.dumps(asdict(figures) | {"all_kills": figures.all_kills}))


if __name__ == "__main__":
    main()
