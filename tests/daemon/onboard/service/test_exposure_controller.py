"""Settings follow the light between exposures, stay on a line that is well, and obey a person."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from daemon.onboard.capture.exposure_controller import PAN, ExposureController
from daemon.onboard.preflight.service_file import from_mapping
from daemon.onboard.service.messages import ApplyExposureSettings
from processing.radiometry.exposure_control import BINS
from tests.daemon.configuration.test_configuration import GOOD
from tests.daemon.onboard.flight.test_flight import nav

HEADS = ("SU00", "SU01", "SU10", "G")


@dataclass
class Bench:
    """A controller with a flight of known position; records what it sends and emits."""

    control: ExposureController
    flight: Any
    sent: list[ApplyExposureSettings] = field(default_factory=list)
    emitted: list[dict[str, Any]] = field(default_factory=list)

    def fly(self, number: int, level: float, line: str = "A", heads: Any = HEADS) -> None:
        self.control.ordered(number, line)
        counts = [0] * BINS
        counts[int(level * BINS)] = 100
        self.control.update_from_histograms(number, dict.fromkeys(heads, tuple(counts)))
        self.control.apply()


def bench(tmp_path: Path, **section: Any) -> Bench:
    content = copy.deepcopy(GOOD)
    content["head"] = [
        {"sensor": name, "driver": "aravis", "address": f"127.0.0.{k + 2}"}
        | {"exposure_time_us": 4000.0, "tdi_shifts": int(name != "G")}
        for k, name in enumerate(HEADS)
    ]
    content["exposure"] = section
    configuration, rig = from_mapping(content, tmp_path / "service.toml")
    flight = SimpleNamespace(track=SimpleNamespace(last=nav(0.0)), awaits_frames=False)
    sent: list[Any] = []
    emitted: list[dict[str, Any]] = []
    control = ExposureController(
        configuration,
        rig,
        flight,
        lambda _process, message: sent.append(message),
        lambda event, **content: emitted.append({"event": event, **content}),
    )
    return Bench(control, flight, sent, emitted)


def test_pan_heads_are_changed_together_and_every_change_is_emitted(tmp_path: Path) -> None:
    flown = bench(tmp_path, control="automatic")
    flown.fly(1, 0.31)
    (adjust,) = flown.sent
    assert set(adjust.settings) == set(HEADS)
    assert adjust.settings["SU00"] == adjust.settings["SU01"] == adjust.settings["SU10"]
    now = flown.control.settings[PAN]
    assert now.light == pytest.approx(4000.0 * 1.9, rel=0.1)
    # 55 m/s over a GSD of 0.215 m move the image by one row in 3.9 ms.
    assert now.tdi_shifts == 2
    assert [one["by"] for one in flown.emitted] == ["configuration", "automatic"]
    assert flown.emitted[1]["settings"][PAN]["exposure_time_us"] == now.exposure_time_us
    assert flown.emitted[1]["control"] == "automatic"
    assert flown.control.times_ns["0"] == round(now.exposure_time_us * 1000)
    assert "R" not in flown.control.times_ns


def test_nothing_is_changed_while_heads_expose_or_send(tmp_path: Path) -> None:
    flown = bench(tmp_path, control="automatic")
    flown.flight.awaits_frames = True
    flown.fly(1, 0.31)
    assert flown.sent == []
    flown.flight.awaits_frames = False
    assert flown.control.apply()
    assert len(flown.sent) == 1
    assert not flown.control.apply()


def test_a_late_verdict_counts_for_what_that_exposure_was_made_with(tmp_path: Path) -> None:
    flown = bench(tmp_path, control="automatic", lock="never")
    flown.control.ordered(1, "A")
    flown.control.ordered(2, "A")
    counts = [0] * BINS
    counts[int(0.31 * BINS)] = 100
    for number in (1, 2):
        flown.control.update_from_histograms(number, dict.fromkeys(HEADS, tuple(counts)))
        flown.control.apply()
    # Both were exposed alike: the second one is no reason to double the light again.
    assert len(flown.sent) == 1


def test_a_line_that_is_well_is_locked_and_the_next_one_is_not(tmp_path: Path) -> None:
    flown = bench(tmp_path, control="automatic")
    flown.fly(1, 0.31)
    flown.fly(2, 0.6)
    flown.fly(3, 0.31)
    assert len(flown.sent) == 1
    assert flown.emitted[-1]["locked_on"] == "A"
    flown.fly(4, 0.31, line="B")
    assert len(flown.sent) == 2
    # The lock and its end are emitted.
    assert [one["locked_on"] for one in flown.emitted] == [None, None, "A", None, None]
    free = bench(tmp_path, control="automatic", lock="never")
    free.fly(1, 0.6)
    free.fly(2, 0.31)
    assert len(free.sent) == 1


def test_by_hand_nothing_changes_by_itself(tmp_path: Path) -> None:
    flown = bench(tmp_path)
    flown.fly(1, 0.99)
    assert flown.sent == []
    assert [one["by"] for one in flown.emitted] == ["configuration"]


def test_a_persons_settings_go_to_the_heads_and_end_the_automatic(tmp_path: Path) -> None:
    flown = bench(tmp_path, control="automatic")
    assert flown.control.command({"exposure_time_us": 2500.0, "of": "G"}, "operator") is None
    flown.control.apply()
    assert list(flown.sent[0].settings) == ["G"]
    assert flown.sent[0].settings["G"].exposure_time_us == 2500.0
    assert flown.sent[0].settings["G"].tdi_shifts == 0
    assert (flown.emitted[-1]["by"], flown.emitted[-1]["control"]) == ("operator", "manual")
    flown.fly(1, 0.99)
    assert len(flown.sent) == 1
    assert flown.control.command({"control": "automatic"}, "operator") is None
    assert flown.emitted[-1]["control"] == "automatic"
    flown.fly(2, 0.99)
    assert len(flown.sent) == 2


@pytest.mark.parametrize(
    ("wanted", "why"),
    [
        ({}, "needs control"),
        ({"control": "automatic", "gain_db": 3.0}, "not both"),
        ({"gain_db": 3.0, "of": "X"}, "there is pan, G"),
        ({"gain_db": 30.0}, "gain_db is 30; 0 to 12"),
        ({"exposure_time_us": 1e6}, "exposure_time_us is 1e+06; 100 to 20000"),
        ({"tdi_shifts": 99}, "0 to 32"),
    ],
)
def test_what_makes_no_sense_is_refused_and_changes_nothing(
    tmp_path: Path, wanted: dict[str, Any], why: str
) -> None:
    flown = bench(tmp_path)
    refusal = flown.control.command(wanted, "operator")
    assert refusal is not None
    assert why in refusal
    assert not flown.control.apply()
    assert flown.sent == []
