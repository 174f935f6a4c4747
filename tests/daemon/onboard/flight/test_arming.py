"""A service is armed when nothing is missing; a missing prerequisite is named with its action."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daemon.configuration.model import LimitsSection
from daemon.onboard.flight.arming import (
    FILE,
    MissingPrerequisite,
    Readiness,
    absent_parts,
    missing_prerequisites,
    override_message,
    overrides_content,
    overrides_of,
)
from daemon.onboard.flight.event_table import entry_of

READY = Readiness(
    has_kernels=True,
    absent=(),
    exposures_left=500,
    exposures_planned=400,
    needs_time=True,
    has_time=True,
    position_age_s=0.1,
    has_fix=True,
    probes_c={"0": (21.0, 0.5), "1": (22.0, 0.5)},
)


def test_nothing_is_missing_where_all_is_there() -> None:
    assert missing_prerequisites(READY, LimitsSection()) == ()


def test_absent_devices_and_data_are_named() -> None:
    assert absent_parts(READY) == []
    probes: dict[str, Any] = {"0": None, "1": (None, 60.0)}
    absent = replace(READY, absent=["head SU00"], position_age_s=None, probes_c=probes)
    assert absent_parts(absent) == ["head SU00", "time and position", "temperature of 0"]
    assert absent_parts(replace(absent, needs_time=False, probes_c={})) == ["head SU00"]


@pytest.mark.parametrize(
    ("change", "name", "part"),
    [
        ({"has_kernels": False}, "arming-kernels", "kernels"),
        ({"absent": ["head SU02"]}, "arming-device", "no head SU02"),
        ({"exposures_left": 399}, "arming-disk", "space for 399 of 400"),
        ({"has_time": False}, "arming-time", "GPS time"),
        ({"position_age_s": None}, "arming-navigation", "no position"),
        ({"has_fix": False}, "arming-navigation", "no position"),
        ({"position_age_s": 9.0}, "arming-navigation", "9 s old"),
        ({"probes_c": {"1": None}}, "arming-temperature", "probe 1"),
        ({"probes_c": {"1": (None, 0.1)}}, "arming-temperature", "probe 1"),
        ({"probes_c": {"1": (20.0, 60.0)}}, "arming-temperature", "older than 10 s"),
        ({"serials_unreported": ["SU00"]}, "arming-serial", "SU00"),
        ({"serials_mismatched": ["lens 0 is 'L-2'"]}, "arming-serial", "lens 0 is 'L-2'"),
    ],
)
def test_each_thing_that_is_missing_is_named_with_its_cure(
    change: dict[str, Any], name: str, part: str
) -> None:
    (item,) = missing_prerequisites(replace(READY, **change), LimitsSection())
    assert (item.name, part in str(item)) == (name, True)
    assert item.action and item.action in str(item)
    assert item.may_be_overridden is (name != "arming-kernels")
    assert entry_of(item.name) is not None


def test_a_rig_without_receiver_and_probes_needs_neither() -> None:
    bare = replace(READY, needs_time=False, has_time=False, position_age_s=None, probes_c={})
    assert missing_prerequisites(bare, LimitsSection()) == ()


@pytest.mark.parametrize(
    ("left", "wanted", "is_enough"),
    [(400, 400, True), (399, 400, False), (1, 0, True), (0, 0, False), (1, 1, True)],
)
def test_the_disk_must_take_what_the_plan_asks_for_and_one_exposure_at_least(
    left: int, wanted: int, is_enough: bool
) -> None:
    readiness = replace(READY, exposures_left=left, exposures_planned=wanted)
    assert (missing_prerequisites(readiness, LimitsSection()) == ()) is is_enough


@pytest.mark.parametrize(
    ("change", "is_outdated"),
    [
        ({"position_age_s": 4.0}, False),
        ({"position_age_s": 4.001}, True),
        ({"probes_c": {"0": (21.0, 7.0)}}, False),
        ({"probes_c": {"0": (21.0, 7.001)}}, True),
        ({"probes_c": {"0": (0.0, 7.0)}}, False),
    ],
)
def test_what_is_as_old_as_its_limit_is_fresh(change: dict[str, Any], is_outdated: bool) -> None:
    limits = LimitsSection(navigation_stale_s=4.0, temperature_stale_s=7.0)
    assert (missing_prerequisites(replace(READY, **change), limits) != ()) is is_outdated


def test_an_override_is_in_the_flight_log_and_a_damaged_note_counts_as_none(tmp_path: Path) -> None:
    item = MissingPrerequisite("arming-device", "no head SU02", "check its cable")
    assert item.may_be_overridden
    content = json.loads(override_message("operator", [item], "training").payload)
    assert (content["by"], content["reason"]) == ("operator", "training")
    assert "reason" not in json.loads(override_message("operator", [item]).payload)
    for note in (b"{", b"{}", b'{"overrides": null}', b'{"overrides": [7]}'):
        (tmp_path / FILE).write_bytes(note)
        assert overrides_of(tmp_path) == []


def test_an_override_is_kept_with_who_when_what_and_why(tmp_path: Path) -> None:
    assert overrides_of(tmp_path) == []
    missing = MissingPrerequisite("arming-device", "no head SU02", "check its cable")
    (tmp_path / FILE).write_bytes(overrides_content(tmp_path, "operator", [missing]))
    again = overrides_content(tmp_path, "uid 1000", [missing], reason="it is not needed")
    (tmp_path / FILE).write_bytes(again)
    first, second = overrides_of(tmp_path)
    assert first["by"] == "operator"
    assert (second["by"], second["reason"]) == ("uid 1000", "it is not needed")
    assert first["missing"] == ["no head SU02 (check its cable)"]
    assert first["utc"].endswith("+00:00")
