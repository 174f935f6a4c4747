"""The service's view of its disks: which are full, released, bad, and where small files go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon.configuration.model import Configuration, LimitsSection
from daemon.mission.layout import Mission
from daemon.mission.mirror.mirror_startup import FoundDisks
from daemon.mission.store.disk_identity import Disk
from daemon.mission.store.health import DiskHealth
from daemon.onboard.flight.fault_latches import FaultLatches
from daemon.onboard.service.messages import (
    AcceptDisk,
    DiskChanged,
    DropDisk,
    EndMission,
    ReleaseDisk,
    WriteSmallFile,
)
from daemon.onboard.storage import mirror as module
from daemon.onboard.storage.mirror import Mirror
from tests.daemon.small_camera import small_rig

pytestmark = pytest.mark.trust

RESERVE, NEEDED = 1000, 300


class Seen:
    def __init__(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, mirrored: bool = True
    ) -> None:
        monkeypatch.setattr(module, "exposure_nbytes", lambda *_: NEEDED // 3)
        monkeypatch.setattr(module, "HEALTH_EVERY_S", 0.0)
        monkeypatch.setattr(module, "read_health", lambda root: self.health.get(root.name))
        monkeypatch.setattr(module, "_free_nbytes", lambda root: self.free[root.name])
        self.sent: list[object] = []
        self.events: list[dict[str, Any]] = []
        self.moved: list[Mission] = []
        self.free: dict[str, int | None] = {"a": 10_000, "b": 10_000}
        self.health: dict[str, DiskHealth] = {}
        self.roots = [tmp_path / name for name in ("a", "b")]
        for root in self.roots:
            root.mkdir()
        labels = ("root", "mirror")
        self.disks = tuple(Disk(k, r, k) for k, r in zip(labels, self.roots, strict=True))
        mission = Mission(self.roots[0] / "m", "m")
        limits = LimitsSection(disk_reserve_bytes=RESERVE)
        self.mirror = Mirror(
            FoundDisks(self.disks, mission) if mirrored else None,
            mission,
            Configuration.model_construct(limits=limits),
            small_rig(),
            lambda _name, message: self.sent.append(message),
            lambda event, **content: self.events.append({"event": event, **content}),
            self.moved.append,
        )

    def changed(self, name: str, disk: int, *in_use: int) -> None:
        disks = tuple(self.disks[i] for i in in_use)
        message = DiskChanged(name, self.disks[disk], "it is so", disks, 1)
        self.mirror.handlers[DiskChanged](message)


@pytest.fixture
def seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Seen:
    made = Seen(tmp_path, monkeypatch)
    made.changed("disk-joined", 1, 0, 1)
    return made


def test_a_full_disk_is_dropped_once_where_the_other_has_room(seen: Seen) -> None:
    seen.free["b"] = RESERVE + NEEDED
    seen.mirror.check()
    assert seen.sent == [] and seen.mirror.free_bytes(Path()) == RESERVE + NEEDED
    seen.free["b"] = RESERVE + NEEDED - 1
    for _ in range(2):
        seen.mirror.check()
    assert seen.sent == [DropDisk("mirror", "it has no space for another exposure")]
    seen.free["a"] = seen.free["b"] = 0
    seen.mirror.check()
    assert len(seen.sent) == 1, "where both are full none is dropped"


def test_another_leading_disk_moves_the_mission_and_raises_a_fault_that_its_return_ends(
    seen: Seen,
) -> None:
    seen.changed("disk-dropped", 0, 1)
    assert seen.moved == [Mission(seen.roots[1] / "m", "m")]
    latches = FaultLatches()
    for event in seen.events:
        latches.apply(event)
    assert [(f["id"], f["stands"]) for f in latches.listed()] == [("disk root", True)]
    seen.changed("disk-joined", 0, 1, 0)
    latches.apply(seen.events[-1])
    assert not latches.listed()[0]["stands"] and len(seen.moved) == 1


def test_disks_are_released_and_accepted_only_where_that_is_possible(seen: Seen) -> None:
    assert "in use" in str(seen.mirror.accept("mirror"))
    assert "no disk 'other'" in str(seen.mirror.release("other"))
    assert seen.mirror.release("mirror") is None
    seen.changed("disk-released", 1, 0)
    assert "may be unmounted" in str(seen.mirror.release("mirror"))
    assert "only one" in str(seen.mirror.release("root"))
    assert seen.mirror.accept("mirror") is None
    assert seen.sent == [ReleaseDisk("mirror"), AcceptDisk("mirror")]


def test_small_files_go_through_the_writer_until_it_ends(seen: Seen) -> None:
    seen.mirror.save_now("note.json", b"1")
    seen.mirror.land(ends_mission=True)
    seen.mirror.save_now("note.json", b"2")
    assert seen.sent == [WriteSmallFile("note.json", b"1"), EndMission()]
    assert [(root / "note.json").read_bytes() for root in seen.roots] == [b"2", b"2"]


def test_a_bad_disk_is_a_fault_until_it_is_well_and_a_figure_all_the_while(seen: Seen) -> None:
    seen.health["a"] = DiskHealth("M", "S", 80.0, 5.0, ("it is 80 degC hot",))
    for _ in range(2):
        seen.mirror.check()
    seen.health["a"] = DiskHealth("M", "S", 60.0, 5.0)
    seen.mirror.check()
    health_events = [e for e in seen.events if e["event"] == "disk-health"]
    assert [(e["fault"], e["disk"]) for e in health_events] == [(True, "root"), (False, "root")]
    assert "80 degC" in health_events[0]["sentence"]
    latches = FaultLatches()
    latches.apply(health_events[0])
    assert latches.listed()[0]["stands"]
    latches.apply(health_events[1])
    assert not latches.listed()[0]["stands"]


def test_one_disk_is_as_ever_and_shown_only_where_its_health_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Seen(tmp_path, monkeypatch, mirrored=False)
    seen.mirror.check()
    assert not seen.mirror.is_on and seen.mirror.plan is None and seen.mirror.status == []
    assert "one disk" in str(seen.mirror.release("root"))
    seen.mirror.save_now("note.json", b"1")
    seen.mirror.land(ends_mission=True)
    assert seen.sent == [] and (seen.roots[0] / "note.json").read_bytes() == b"1"
    seen.health["a"] = DiskHealth("M", "S", 41.0, 3.0)
    seen.mirror.check()
    (disk,) = seen.mirror.status
    assert (disk["disk"], disk["temperature_c"], disk["healthy"]) == ("root", 41.0, True)
