"""A fault stays until a person has acknowledged it, over the end of the service too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon.flight.latches import (
    FILE,
    KEPT,
    Latches,
    previous_faults,
    read_unhandled,
    unhandled_note,
)


def device(name: str, *, fault: bool = True, of: str = "SU02") -> dict[str, Any]:
    return {"event": "device", "device": of, "name": name, "fault": fault, "sentence": "look"}


def latches_of(*events: dict[str, Any]) -> Latches:
    latches = Latches()
    for sequence, event in enumerate(events, 1):
        latches.apply(event, sequence=sequence)
    return latches


def test_what_nobody_acknowledged_is_told_again_after_a_restart(tmp_path: Path) -> None:
    before = latches_of(device("lost"), {"event": "disk", "sentence": "full"})
    assert before.acknowledge("disk")
    (tmp_path / FILE).write_bytes(unhandled_note(before.unhandled()))
    after = latches_of(*previous_faults(read_unhandled(tmp_path)))
    (fault,) = after.listed()
    assert (fault["id"], fault["previous"], fault["stands"]) == ("device SU02", True, False)
    assert after.acknowledge("device SU02")
    (tmp_path / FILE).write_bytes(unhandled_note(after.unhandled()))
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
    latches = latches_of(*({"event": "lost", "number": n, "cause": "x"} for n in range(KEPT + 50)))
    assert len(latches.listed()) == KEPT


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
