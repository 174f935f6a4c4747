"""A fault stays until a person has acknowledged it, over the end of the service too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon.onboard.flight.fault_latches import (
    FAULTS_MAX,
    FILE,
    FaultLatches,
    LatchedFault,
    previous_faults,
    read_unhandled,
    unhandled_content,
)


def device(name: str, *, fault: bool = True, of: str = "SU02") -> dict[str, Any]:
    return {"event": "device", "device": of, "name": name, "fault": fault, "sentence": "look"}


def latches_of(*events: dict[str, Any]) -> FaultLatches:
    latches = FaultLatches()
    for sequence, event in enumerate(events, 1):
        latches.apply(event, sequence=sequence)
    return latches


def test_an_unacknowledged_fault_is_reported_again_after_a_restart(tmp_path: Path) -> None:
    before = latches_of(device("lost"), {"event": "disk", "sentence": "full"})
    assert before.acknowledge("disk")
    (tmp_path / FILE).write_bytes(unhandled_content(before.unhandled()))
    after = latches_of(*previous_faults(read_unhandled(tmp_path)))
    (fault,) = after.listed()
    assert (fault["id"], fault["previous"], fault["stands"]) == ("device SU02", True, False)
    assert after.acknowledge("device SU02")
    (tmp_path / FILE).write_bytes(unhandled_content(after.unhandled()))
    assert read_unhandled(tmp_path) == ()


def test_a_fault_that_comes_again_stands_and_counts_on() -> None:
    latches = latches_of(*previous_faults(latches_of(device("lost")).unhandled()), device("lost"))
    (fault,) = latches.listed()
    assert (fault["stands"], fault["previous"], fault["count"]) == (True, False, 2)


def test_a_complaint_of_a_device_that_delivers_does_not_stand() -> None:
    (fault,) = latches_of(device("checksum", of="gnss")).listed()
    assert (fault["id"], fault["stands"], fault["acknowledged"]) == ("checksum gnss", False, False)


def test_a_clock_that_coasts_passes_by_itself_and_stays_listed() -> None:
    holdover = device("pps-holdover", of="clock")
    back = device("pps-holdover", of="clock", fault=False)
    (fault,) = latches_of(holdover, back).listed()
    assert (fault["id"], fault["stands"]) == ("clock pps-holdover", False)


def test_a_damaged_file_of_faults_hinders_no_start(tmp_path: Path) -> None:
    for content in (b"", b"{", b'{"faults": 7}', b'{"faults": [{"id": 3}, [], "x"]}'):
        (tmp_path / FILE).write_bytes(content)
        assert read_unhandled(tmp_path) == ()


def test_they_never_grow_beyond_their_bounds() -> None:
    latches = latches_of(
        *({"event": "lost", "number": n, "cause": "x"} for n in range(FAULTS_MAX + 50))
    )
    assert len(latches.listed()) == FAULTS_MAX == 200
    assert latches.listed()[0]["id"] == "exposure 249", "the newest first"
    assert latches.listed()[-1]["id"] == "exposure 50", "the oldest are forgotten"


def test_a_file_of_faults_is_read_to_its_bounds(tmp_path: Path) -> None:
    faults = [LatchedFault(f"fault {n}", "service", "look") for n in range(FAULTS_MAX + 1)]
    content = unhandled_content(faults)
    (tmp_path / FILE).write_bytes(content)
    assert [one.id for one in read_unhandled(tmp_path)] == [one.id for one in faults[:200]]
    (tmp_path / FILE).write_bytes(content.ljust(1_000_000))
    assert len(read_unhandled(tmp_path)) == 200
    (tmp_path / FILE).write_bytes(content.ljust(1_000_001))
    assert read_unhandled(tmp_path) == ()


def test_a_fault_that_was_just_raised_stands_once_and_nobody_has_seen_it() -> None:
    latches = FaultLatches()
    latches.raise_fault("power", "low", "power")
    latches.apply({"event": "disk", "sentence": "full"})
    latches.add_previous([LatchedFault("mirror", "disk", "slow", acknowledged=True)])
    assert LatchedFault("a", "b", "c") == LatchedFault("a", "b", "c", True, False, 1, 0, False)
    power, disk, mirror = latches.unhandled()
    assert power == LatchedFault("power", "power", "low", True, False, 1, 0, False)
    assert disk == LatchedFault("disk", "disk", "full", True, False, 1, 0, False, "disk")
    assert mirror == LatchedFault("mirror", "disk", "slow", False, False, 1, 0, True)
    assert "power" in latches and "clock" not in latches
    assert not latches.acknowledge("clock")
    latches.clear_fault("clock")
    assert len(latches.listed()) == 3


@pytest.mark.parametrize(("left", "stands"), [(0, True), (1, False), (None, True)])
def test_a_disk_fault_passes_when_the_disk_takes_an_exposure_again(
    left: int | None, stands: bool
) -> None:
    latches = latches_of(
        {"event": "disk", "sentence": "full"}, {"event": "status", "exposures_left": left}
    )
    assert [one["stands"] for one in latches.listed()] == [stands]


def test_a_fault_that_was_seen_leaves_the_list_when_it_passes_and_stays_while_it_stands() -> None:
    latches = latches_of(device("lost"))
    assert latches.acknowledge("device SU02")
    assert [(one["stands"], one["acknowledged"]) for one in latches.listed()] == [(True, True)]
    assert latches.unhandled() == ()
    latches.apply(device("recovered", fault=False))
    assert latches.listed() == []


def test_a_disk_that_was_dropped_passes_when_it_joins_again() -> None:
    for cure in ("disk-joined", "disk-released"):
        latches = latches_of({"event": "disk-dropped", "disk": "B", "sentence": "gone"})
        assert latches.listed()[0]["stands"]
        latches.apply({"event": cure, "disk": "B"})
        assert [(one["id"], one["stands"]) for one in latches.listed()] == [("disk B", False)]


def test_a_clock_that_stepped_does_not_stand() -> None:
    (fault,) = latches_of(device("clock-stepped", of="clock")).listed()
    assert (fault["id"], fault["stands"]) == ("clock clock-stepped", False)
    (fault,) = latches_of(device("pps-holdover", of="clock")).listed()
    assert fault["stands"]


@pytest.mark.trust
def test_what_happened_once_does_not_stand() -> None:
    (fault,) = latches_of({"event": "lost", "number": 7, "cause": "no frame came"}).listed()
    assert (fault["id"], fault["stands"], fault["acknowledged"]) == ("exposure 7", False, False)


@pytest.mark.trust
def test_what_was_absent_stands_until_the_status_no_longer_names_it() -> None:
    latches = latches_of(
        {"event": "ready", "absent": ["head SU02", "trigger"]},
        {"event": "status", "absent": ["trigger"]},
    )
    assert {one["id"]: one["stands"] for one in latches.listed()} == {
        "absent head SU02": False,
        "absent trigger": True,
    }
    latches.apply({"event": "status"})  # one that does not say changes nothing
    assert [one["id"] for one in latches.listed() if one["stands"]] == ["absent trigger"]


def test_a_fault_has_the_code_and_severity_of_its_event_and_the_time_of_its_end() -> None:
    raised = device("lost") | {"mono_ns": "5000000000"}
    latches = latches_of(raised, device("checksum", of="gnss") | {"mono_ns": "6000000000"})
    by_id = {fault["id"]: fault for fault in latches.listed()}
    lost, checksum = by_id["device SU02"], by_id["checksum gnss"]
    assert (lost["code"], lost["severity"]) == ("device/lost", "warning")
    assert (checksum["code"], checksum["severity"]) == ("device/checksum", "caution")
    assert (lost["raised_mono_ns"], lost["cleared_mono_ns"]) == ("5000000000", None)
    latches.apply(device("recovered", fault=False) | {"mono_ns": "9000000000"})
    (cleared,) = (fault for fault in latches.listed() if fault["id"] == "device SU02")
    assert (cleared["stands"], cleared["cleared_mono_ns"]) == (False, "9000000000")


def test_an_acknowledged_fault_names_who_acknowledged_it() -> None:
    latches = latches_of(device("lost"))
    assert latches.acknowledge("device SU02", "anna (operator)")
    (fault,) = latches.listed()
    assert (fault["acknowledged"], fault["acknowledged_by"]) == (True, "anna (operator)")


def test_a_mirror_that_works_again_and_an_override_without_need_are_cleared() -> None:
    latches = latches_of(
        {"event": "mirror", "sentence": "one disk is unusable"},
        {"event": "override", "sentence": "no position"},
    )
    one_disk = [{"disk": "root", "state": "in use"}, {"disk": "mirror", "state": "copying"}]
    latches.apply({"event": "status", "disks": one_disk, "missing": ["no position"]})
    assert all(fault["stands"] for fault in latches.listed())
    both = [{"disk": name, "state": "in use"} for name in ("root", "mirror")]
    latches.apply({"event": "status", "disks": both, "missing": []})
    assert not any(fault["stands"] for fault in latches.listed())


@pytest.mark.parametrize(("status", "stands"), [({"is_disk_low": True}, True), ({}, False)])
def test_a_low_disk_is_cleared_only_when_it_is_no_longer_low(
    status: dict[str, Any], stands: bool
) -> None:
    latches = latches_of({"event": "disk", "sentence": "low"})
    latches.apply({"event": "status", "exposures_left": 40} | status)
    (fault,) = latches.listed()
    assert fault["stands"] is stands


def test_faults_whose_cause_is_gone_are_cleared_and_say_since_when() -> None:
    disks = [{"disk": "root", "state": "in use"}, {"disk": "mirror", "state": "rejoining"}]
    latches = latches_of(
        {"event": "decisions", "fault": True, "sentence": "the disk refused"},
        {"event": "prerequisite", "item": "disk mirror", "fault": True, "sentence": "not writable"},
        {"event": "prerequisite", "item": "calibration rig", "fault": True, "sentence": "old"},
        {"event": "status", "mono_ns": "5", "disks": disks},
    )
    assert all(one["stands"] for one in latches.listed())
    disks[1]["state"] = "in use"
    latches.apply({"event": "status", "mono_ns": "6", "disks": disks})
    latches.apply({"event": "decisions", "mono_ns": "7", "fault": False, "sentence": "again"})
    cleared = {one["id"]: one["cleared_mono_ns"] for one in latches.listed() if not one["stands"]}
    assert cleared == {"prerequisite disk mirror": "6", "decisions": "7"}
    # What was configured at the start holds until the next one.
    assert "prerequisite calibration rig" in latches


def test_a_triangulation_that_works_again_is_cleared() -> None:
    latches = latches_of(
        {"event": "triangulation-failed", "fault": True, "sentence": "ended", "mono_ns": "3"},
    )
    assert latches.listed()[0]["stands"]
    latches.apply({"event": "triangulated", "number": 7, "mono_ns": "8"})
    (fault,) = latches.listed()
    assert (fault["stands"], fault["cleared_mono_ns"]) == (False, "8")


@pytest.mark.parametrize("event", ["ledger", "power", "fault"])
def test_a_fault_that_ended_the_service_no_longer_stands_after_its_restart(event: str) -> None:
    before = latches_of({"event": event, "fault": True, "sentence": "the service ends"})
    (fault,) = latches_of(*previous_faults(before.unhandled())).listed()
    assert (fault["stands"], fault["previous"]) == (False, True)
