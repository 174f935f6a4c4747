"""`syntopic check` proves that a position with a height and a usable time arrived."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult
from daemon.onboard.preflight.service_file import from_mapping
from daemon.onboard.preflight.system_check import SystemCheck
from daemon.onboard.service.messages import DeviceSpec
from drivers.contract import DeviceEvent
from drivers.receivers.fix_monitor import fix_description
from tests.daemon.configuration.test_configuration import GOOD
from tests.daemon.onboard.flight.test_flight import mark, nav, pulse

pytestmark = pytest.mark.trust


def checked(tmp_path: Path, driver: str, *messages: object) -> tuple[SystemCheck, DeviceSpec]:
    content = copy.deepcopy(GOOD)
    port = {} if driver == "gpsd" else {"port": "/dev/ttyS0"}
    content["navigator"] = [{"name": "gnss", "driver": driver, **port}]
    system_check = SystemCheck(*from_mapping(content, tmp_path / "service.toml"), fire=True)
    for message in messages:
        system_check._dispatch(message)
    (spec,) = (spec for spec in system_check._specs if spec.kind == "navigator")
    return system_check, spec


def found(tmp_path: Path, *messages: object) -> CheckResult:
    """What check finds of the navigator's stream after these messages."""
    system_check, spec = checked(tmp_path, "gpsd", *messages)
    return system_check._navigation(spec)


@pytest.mark.parametrize(
    "driver",
    [
        "nmea",
        "mavlink",
        "ublox",
        "novatel",
        "septentrio",
        "sbg",
        "vectornav",
        "xsens",
        "applanix",
        "gsof",
    ],
)
def test_the_event_mark_of_every_receiver_that_can_give_one_is_proven(
    tmp_path: Path, driver: str
) -> None:
    system_check, spec = checked(tmp_path, driver, mark(pulse(1, 0.0)))
    proven = system_check._mark(spec)
    assert proven.outcome is CheckOutcome.PASS
    is_from_manual = driver in ("sbg", "vectornav", "xsens", "applanix", "gsof")
    assert proven.sentence == (
        f"marks of driver {driver} are decoded from the manual only" if is_from_manual else ""
    )
    system_check, spec = checked(tmp_path, driver)
    result = system_check._mark(spec)
    assert result.outcome is CheckOutcome.FAIL
    assert result.sentence == (
        "receiver gnss gave no event mark of the exposure; check the strobe cable, and that the "
        "receiver is set to send its marks"
    )


def test_gpsd_has_no_event_marks_to_prove(tmp_path: Path) -> None:
    system_check, spec = checked(tmp_path, "gpsd")
    assert system_check._mark(spec).outcome is CheckOutcome.NOT_TRIED


def test_a_position_with_height_and_time_passes_and_names_the_leap_table(tmp_path: Path) -> None:
    result = found(tmp_path, replace(nav(0.0), leap_source="table"))
    assert (result.outcome, result.sentence) == (
        CheckOutcome.PASS,
        "3d, 12 satellites, GPS time by our table of leap seconds",
    )
    assert found(tmp_path, nav(0.0)).sentence == "3d, 12 satellites"


@pytest.mark.parametrize(
    ("sample", "sentence"),
    [
        (
            replace(nav(0.0), fix="none", latitude_deg=None, longitude_deg=None, satellites=0),
            "no position yet (searching, 0 satellites); wait",
        ),
        (replace(nav(0.0), fix="time"), "no position yet (searching, 12 satellites)"),
        (replace(nav(0.0), time_valid=False), "no usable time yet (3d, 12 satellites)"),
        (replace(nav(0.0), fix="2d", height_m=None), "no height yet (2d, 12 satellites)"),
    ],
)
def test_what_is_missing_is_waited_for_by_name(
    tmp_path: Path, sample: object, sentence: str
) -> None:
    result = found(tmp_path, sample)
    assert result.outcome is CheckOutcome.WAITING
    assert sentence in result.sentence


def test_before_any_position_the_receivers_own_sentence_is_shown(tmp_path: Path) -> None:
    sentence = f"The receiver gnss is {fix_description('none', 0)}. Wait."
    result = found(tmp_path, DeviceEvent("gnss", "searching", False, sentence, 0))
    assert (result.outcome, result.sentence) == (CheckOutcome.WAITING, sentence)
