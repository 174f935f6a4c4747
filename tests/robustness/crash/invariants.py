"""What must be true of a disk after a power cut, whatever it took: judged after real recovery."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from daemon.mission.catalog.catalog import Catalog
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.log.log_records import Message
from daemon.mission.store.level0 import read_tiff
from daemon.mission.store.level0_folder import read_sealed
from daemon.mission.store.store import Level0Writer, verify
from daemon.mission.verification.recovery import RecoveryReport, recover
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.recovery_match import seal_from_log
from tests.daemon.small_camera import final_record, pixels_of, small_rig, store_one

ALLOWED_PROBLEMS = ("was damaged on the disk; read with care",)
"""Finding about the end of a log that was never synced: it is read as far as possible."""


@dataclass
class Acknowledged:
    """Acknowledgements sent before the cut; they must hold afterwards."""

    mission: str = ""
    stored: set[int] = field(default_factory=set)
    sealed: dict[int, str] = field(default_factory=dict)
    triggered: set[int] = field(default_factory=set)
    processed: set[int] = field(default_factory=set)
    logged: list[int] = field(default_factory=list)
    is_closed: bool = False

    def add_line(self, line: str) -> None:
        what, first, *rest = line.split()
        if what == "mission":
            self.mission = first
        elif what == "triggered":
            self.triggered.add(int(first))
        elif what == "stored":
            self.stored.add(int(first))
        elif what == "sealed":
            self.sealed[int(first)] = rest[0]
        elif what == "processed":
            self.processed.add(int(first))
        elif what == "logged":
            self.logged.append(int(first))
        elif what == "closing":
            self.is_closed = True


@dataclass(frozen=True)
class Outcome:
    """What recovery made of a state."""

    report: RecoveryReport | None
    exposures: int
    discarded: int


def check_invariants(root: Path, acknowledged: Acknowledged, *, flies_on: bool) -> Outcome:
    """Recover the mission below `root` and compare it with the acknowledgements; then fly again.

    Raises:
        AssertionError: an acknowledgement does not hold, or a report is wrong.
    """
    missions = sorted(p for p in root.glob("2*") if p.is_dir()) if root.is_dir() else []
    if not missions:
        assert not acknowledged.mission, "the mission is gone"
        assert not root.is_dir() or Mission.current(root) is None
        return Outcome(None, 0, 0)
    mission = Mission.open(missions[0])
    current = Mission.current(root) if not acknowledged.is_closed else mission
    assert current is not None or not acknowledged.mission, "the flight does not go on"
    complete = seal_from_log(small_rig())
    logged = [_message_count(path) for path in logs_of(mission.log_dir)]
    with mission.held():
        report = recover(mission, complete)
        assert all(p.endswith(ALLOWED_PROBLEMS) for p in report.problems), report.problems
        _check_acknowledged(mission, acknowledged, logged)
        _check_shown(mission, report)
        assert verify(mission).problems == ()
        before = snapshot(mission)
        again = recover(mission, complete)
        assert (again.done, again.sealed, again.lost) == ((), (), ())
        assert snapshot(mission) == before, "a second recovery changed something"
        assert again.next_number == report.next_number
        if flies_on:
            _fly_on(mission, report.next_number)
            assert verify(mission).problems == ()
    discarded = len(list((mission.level0_root / ".discarded").glob("*")))
    return Outcome(report, len(mission.numbers()), discarded)


def snapshot(mission: Mission) -> object:
    """All of a mission but the file of its index, of which the content counts."""
    files = {
        str(path.relative_to(mission.path)): path.read_bytes() if path.is_file() else None
        for path in sorted(mission.path.rglob("*"))
        if not path.name.startswith(("mission.db", ".held"))
    }
    index = Catalog.read(mission.catalog_path)
    rows = [(row, index.frames(row.number)) for row in index.exposures()]
    content = (files, rows, index.processed_numbers(), index.verdicts(), index.events())
    index.close()
    return content


def _check_acknowledged(
    mission: Mission, acknowledged: Acknowledged, logged: Sequence[int]
) -> None:
    for number in acknowledged.stored:
        record = read_sealed(mission.level0(number))
        assert record is not None, f"{number} was called stored and is not sealed"
        assert record.exposure.frames, f"{number} was called stored and has no frames"
    for number, sha256 in acknowledged.sealed.items():
        record = read_sealed(mission.level0(number))
        assert record is not None and record.sha256 == sha256, f"the record of {number} changed"
    assert acknowledged.triggered <= set(mission.numbers()), "a trigger has no record"
    for number in acknowledged.processed:
        pan = read_tiff(mission.level2(number) / "pan.tif")
        assert (pan == number).all(), f"the products of {number}"
    for found, promised in zip(logged, acknowledged.logged, strict=False):
        assert found >= promised, f"{promised} messages were synced and {found} are there"
    if acknowledged.logged:
        assert len(logged) >= len(acknowledged.logged) - sum(
            a < b for a, b in zip(acknowledged.logged, acknowledged.logged[1:], strict=False)
        )


def _check_shown(mission: Mission, report: RecoveryReport) -> None:
    """Whatever is presented as an exposure is whole, and in the index as on the disk."""
    finalized = {exposure.number: exposure for exposure in report.finalized}
    assert sorted(finalized) == mission.numbers()
    for number, exposure in finalized.items():
        assert exposure.frames or exposure.state == "lost"
        pixels = pixels_of(number)
        for frame in exposure.frames:
            path = mission.level0(number) / frame.file
            assert hashlib.sha256(path.read_bytes()).hexdigest() == frame.sha256
            assert (read_tiff(path) == pixels[frame.sensor]).all(), f"{number} {frame.sensor}"
    index = Catalog.read(mission.catalog_path)
    rows = {row.number: row for row in index.exposures()}
    index.close()
    assert sorted(rows) == sorted(finalized) and all(row.is_sealed for row in rows.values())
    assert Ledger.resume(report.finalized).sheet().is_balanced
    assert report.next_number > max([0, *finalized])


def _fly_on(mission: Mission, number: int) -> None:
    writer = Level0Writer(mission, threads=1)
    stored = store_one(writer, number)
    writer.seal(replace(final_record(stored), previous_sha256=writer.head_sha256))
    writer.close()


def _message_count(path: Path) -> int:
    ours: list[Message] = [m for m in read(path) if not m.topic.startswith("log/")]
    return len(ours)
