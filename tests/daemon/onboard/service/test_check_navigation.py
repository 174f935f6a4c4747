"""`syntopic check` proves that a position with a height and a usable time arrived."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.configuration.model import from_mapping
from daemon.onboard.preflight.findings import Finding, Outcome
from daemon.onboard.preflight.trial import Trial
from daemon.onboard.service.messages import DeviceSpec
from drivers.contract import DeviceEvent
from drivers.receivers.receiver_fix import fix_in_words
from tests.daemon.configuration.test_configuration import GOOD
from tests.daemon.onboard.flight.test_flight import mark, nav, pulse

pytestmark = pytest.mark.trust


def tried(tmp_path: Path, driver: str, *heard: object) -> tuple[Trial, DeviceSpec]:
    content = copy.deepcopy(GOOD)
    port = {} if driver == "gpsd" else {"port": "/dev/ttyS0"}
    content["navigator"] = [{"name": "gnss", "driver": driver, **port}]
    trial = Trial(*from_mapping(content, tmp_path / "service.toml"), fire=True)
    for message in heard:
        trial._hear(message)
    (spec,) = (spec for spec in trial._specs if spec.kind == "navigator")
    return trial, spec


def found(tmp_path: Path, *heard: object) -> Finding:
    """What check finds of the navigator's stream after these messages."""
    trial, spec = tried(tmp_path, "gpsd", *heard)
    return trial._navigation(spec)


@pytest.mark.parametrize("driver", ["nmea", "mavlink", "ublox", "novatel", "septentrio"])
def test_the_event_mark_of_every_receiver_that_can_give_one_is_proven(
    tmp_path: Path, driver: str
) -> None:
    trial, spec = tried(tmp_path, driver, mark(pulse(1, 0.0)))
    assert trial._mark(spec).outcome is Outcome.PASS
    trial, spec = tried(tmp_path, driver)
    finding = trial._mark(spec)
    assert finding.outcome is Outcome.FAIL
    assert finding.sentence == (
        "receiver gnss gave no event mark of the exposure; check the strobe cable, and that the "
        "receiver is set to send its marks"
    )


def test_gpsd_has_no_event_marks_to_prove(tmp_path: Path) -> None:
    trial, spec = tried(tmp_path, "gpsd")
    assert trial._mark(spec).outcome is Outcome.NOT_TRIED


def test_a_position_with_height_and_time_passes_and_names_the_leap_table(tmp_path: Path) -> None:
    finding = found(tmp_path, replace(nav(0.0), leap_source="table"))
    assert (finding.outcome, finding.sentence) == (
        Outcome.PASS,
        "3d, 12 satellites, GPS time by our table of leap seconds",
    )
    assert found(tmp_path, nav(0.0)).sentence == "3d, 12 satellites"


@pytest.mark.parametrize(
    ("sample", "said"),
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
def test_what_is_missing_is_waited_for_by_name(tmp_path: Path, sample: object, said: str) -> None:
    finding = found(tmp_path, sample)
    assert finding.outcome is Outcome.WAITING
    assert said in finding.sentence


def test_before_any_position_the_receivers_own_sentence_is_shown(tmp_path: Path) -> None:
    sentence = f"The receiver gnss is {fix_in_words('none', 0)}. Wait."
    finding = found(tmp_path, DeviceEvent("gnss", "searching", False, sentence, 0))
    assert (finding.outcome, finding.sentence) == (Outcome.WAITING, sentence)
