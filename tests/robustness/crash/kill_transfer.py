"""`transfer`, killed at its calls: `python -m tests.robustness.crash.kill_transfer FOLDER WHAT`.

WHAT is `every`, for one kill at each state-changing call; `pairs:COUNT:SEED`, for two kills in a
row at random calls; or `once:FORGOTTEN`, for one run whose writes are recorded. After each kill a
complete, verified copy must exist. In the end the copy must be sealed and complete, and the source
removed.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import stat
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from daemon.mission.catalog.catalog import Catalog
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_seals import seal_logs
from daemon.mission.store import durable
from daemon.mission.store.level2 import write_level2
from daemon.mission.store.store import Level0Writer
from daemon.mission.transfer.transfer import finish_transfer, transfer
from daemon.mission.transfer.transfer_manifest import EXCLUDED_FILES, MANIFEST_FILE
from daemon.mission.transfer.transfer_removal import removing_path
from daemon.mission.verification.verification import verify
from tests.daemon.small_camera import final_record, new_mission, store_one
from tests.robustness.crash.kill_at_call import WRITES, run_to_call

FLOWN = "flown"
OTHER_DISK = "disk"
BEGUN = "begun"
"""Created below the folder of a recorded run when the transfer begins."""

INDEX = "mission.db"
"""Not compared byte by byte: `verify` compares its content."""

Content = Mapping[str, str]
"""SHA-256 by file name."""


@dataclass
class Figures:
    """What was done, and what was found."""

    calls: int = 0
    kills: int = 0
    torn_writes: int = 0
    wrong: list[str] = field(default_factory=list)


def three_exposures(root: Path) -> Mission:
    """A mission of three exposures with products, a log and an export."""
    mission = new_mission(root)
    writer = Level0Writer(mission)
    for number in (1, 2, 3):
        writer.seal(final_record(store_one(writer, number, ["SU00"])))
    writer.close()
    write_level2(
        mission,
        1,
        report_json={"verdict": "good"},
        pan=None,
        colour={},
        quicklook=None,
    )
    durable.create_file(mission.export_dir / "report.html", [b"report"], mode=0o644)
    log = FlightLog.create(mission.log_dir)
    log.append("raw/gnss", 1, b"bytes" * 100)
    log.close()
    seal_logs(mission)
    mission.close()
    Catalog.open(mission.catalog_path).close()
    for path in (*mission.path.rglob("*"), mission.path, root):
        durable.sync_file(path)  # as a mission is that was flown a while ago
    return mission


def content_of(folder: Path) -> Content:
    """What is in a folder, without notes, locks and unfinished files."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in {*EXCLUDED_FILES, INDEX}
    }


def is_complete(folder: Path, original: Content) -> bool:
    """Whether a folder is a complete copy that verifies."""
    return (
        (folder / "L0").is_dir()
        and content_of(folder) == original
        and (folder / INDEX).is_file()
        and verify(Mission.open(folder)).is_intact
    )


class TransferCase:
    """A mission on one disk, and the folder of another."""

    def __init__(self, source: Path, disk: Path, original: Content | None = None) -> None:
        self.source = source
        self.disk = disk
        self.target = disk / source.name
        self.original = original or content_of(source)

    def moved_to(self, folder: Path) -> TransferCase:
        """The same trial with both disks below another folder."""
        return TransferCase(folder / FLOWN / self.source.name, folder / OTHER_DISK, self.original)

    def run(self) -> None:
        """What the command does."""
        if self.source.exists():
            transfer(Mission.open(self.source), self.disk, remove_source=True)
        else:
            assert finish_transfer(self.source, self.disk) is not None

    def check_interrupted(self, *, reruns: bool) -> None:
        """What holds at any instant; then the next run finishes.

        Raises:
            AssertionError: something was lost or changed.
        """
        source = self.source.exists() and is_complete(self.source, self.original)
        assert source or not self.source.exists(), "half of the source has the source's name"
        assert source or is_complete(self.target, self.original), "no complete copy is left"
        if reruns:
            sealed = self.seal()
            self.run()
            assert sealed in (None, self.seal()), "a sealed copy was changed"
            self.check_finished()

    def seal(self) -> Content | None:
        """All of the copy, once it is sealed."""
        note = self.target / MANIFEST_FILE
        if not note.exists() or json.loads(note.read_text())["state"] != "sealed":
            return None
        return {**content_of(self.target), MANIFEST_FILE: note.read_text()}

    def check_finished(self) -> None:
        """What holds after a run that came to its end."""
        assert is_complete(self.target, self.original), "the copy is not complete"
        assert self.seal() is not None, "the copy is not sealed"
        assert not self.source.exists() and not removing_path(self.source).exists()
        assert not list(self.disk.parent.rglob("*.part")), "unfinished files are left"


def kill_at(pristine: TransferCase, scratch: Path, positions: list[tuple[int, bool]]) -> None:
    """Kill one run after the other, then let one finish.

    Raises:
        AssertionError: something was lost, or a run does not finish.
    """
    case = _begin(pristine, scratch)
    sealed: Content | None = None
    for last, torn in positions:
        run_to_call(case.run, last, torn=torn)
        assert sealed in (None, case.seal()), "a sealed copy was changed"
        sealed = case.seal()
        case.check_interrupted(reruns=False)
    case.check_interrupted(reruns=True)


def _begin(pristine: TransferCase, scratch: Path) -> TransferCase:
    shutil.rmtree(scratch, ignore_errors=True)
    case = pristine.moved_to(scratch)
    case.disk.mkdir(parents=True)
    shutil.copytree(pristine.source, case.source)
    return case


def run_once(folder: Path, forgets: str) -> None:
    """Fly, note that the transfer begins, and transfer; `forgets` leaves syncs out."""
    mission = three_exposures(folder / FLOWN)
    (folder / BEGUN).touch()
    if forgets != "nothing":
        _forget(is_folder=forgets == "folders")
    TransferCase(mission.path, folder / OTHER_DISK).run()


def _forget(*, is_folder: bool) -> None:
    sync = os.fsync

    def some(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode) != is_folder:
            sync(descriptor)

    os.fsync = some


def main() -> None:
    folder, (what, *given) = Path(sys.argv[1]), sys.argv[2].split(":")
    if what == "once":
        run_once(folder, given[0])
        return
    figures = Figures()
    pristine = TransferCase(three_exposures(folder / FLOWN).path, folder / OTHER_DISK)
    case = _begin(pristine, folder / "trial")
    calls = run_to_call(case.run, None)
    case.check_finished()
    figures.calls = len(calls)
    if what == "every":
        rounds = [[(number, False)] for number in range(1, len(calls) + 1)]
        rounds += [[(n, True)] for n, call in enumerate(calls, 1) if call in WRITES]
    else:
        rng = random.Random(int(given[1]))
        rounds = [
            [(rng.randint(1, len(calls)), rng.random() < 0.2) for _ in range(2)]
            for _ in range(int(given[0]))
        ]
    for positions in rounds:
        figures.kills += len(positions)
        figures.torn_writes += sum(torn for _, torn in positions)
        try:
            kill_at(pristine, folder / "trial", positions)
        except Exception as error:  # noqa: BLE001 - whatever a later run raises is a finding
            figures.wrong.append(f"{positions}: {type(error).__name__}: {error}")
    print(json.dumps(asdict(figures)))


if __name__ == "__main__":
    main()
