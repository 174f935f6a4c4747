"""`syntopic check` proves that a position with a height and a usable time arrived."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.configuration import from_mapping
from daemon.service.findings import Finding, Outcome
from daemon.service.trial import Trial
from drivers.contract import DeviceEvent
from drivers.receiver_fix import fix_in_words
from tests.daemon.flight.test_flight import nav
from tests.daemon.test_configuration import GOOD

pytestmark = pytest.mark.trust


def found(tmp_path: Path, *heard: object) -> Finding:
    """What check finds of the navigator's stream after these messages."""
    content = copy.deepcopy(GOOD)
    content["navigator"] = [{"name": "gnss", "driver": "gpsd"}]
    trial = Trial(*from_mapping(content, tmp_path / "service.toml"), fire=False)
    for message in heard:
        trial._hear(message)
    (spec,) = (spec for spec in trial._specs if spec.kind == "navigator")
    return trial._navigation(spec)


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
