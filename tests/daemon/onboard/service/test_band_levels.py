"""A colour head whose exposure time changes in flight is reported at the next exposure."""

from __future__ import annotations

from typing import Any

import pytest

from daemon.onboard.service.messages import Processed
from tests.daemon.onboard.service.sequence_bench import SequenceBench

FIELDS = {"red": 0.77, "green": 0.90, "blue": 0.55, "nir": 2.3}
WATER = {"red": 0.80, "green": 1.20, "blue": 1.46, "nir": 0.32}
HALVED = {**FIELDS, "red": 0.385}


def flown(*levels: dict[str, float]) -> list[tuple[int, dict[str, Any]]]:
    """The warnings about levels while exposures with these levels are processed."""
    bench, found = SequenceBench(), []

    def emit(event: str, **content: Any) -> None:
        if event == "band-level":
            found.append((content["number"], content))

    bench.sequence._emit = emit
    for number, of_bands in enumerate(levels):
        figures = {f"{band}_over_pan": level for band, level in of_bands.items()}
        report = {"verdict": "good", "figures": figures}
        bench.receive(Processed(number, report, {}, 1.0, {}))
    return found


@pytest.mark.trust
def test_red_exposed_half_as_long_is_reported_with_the_exposure_from_which_on() -> None:
    (down, up) = flown(FIELDS, FIELDS, HALVED, HALVED, HALVED, FIELDS)
    number, content = down
    assert (number, content["band"], content["before"], content["factor"]) == (2, "red", 1, 0.5)
    assert "level of red" in content["sentence"] and "Check the settings" in content["sentence"]
    assert (up[0], up[1]["band"], up[1]["factor"]) == (5, "red", 2.0)


@pytest.mark.trust
def test_a_change_over_other_ground_is_reported_when_like_ground_returns() -> None:
    halved_water = {**WATER, "red": 0.4}
    (down,) = flown(FIELDS, WATER, FIELDS, halved_water)
    assert (down[0], down[1]["before"]) == (3, 1)
    (down,) = flown(FIELDS, halved_water, HALVED)
    assert (down[0], down[1]["before"]) == (2, 0)


def test_ground_that_changes_raises_nothing() -> None:
    woods = {"red": 0.40, "green": 0.95, "blue": 0.50, "nir": 3.4}
    soil = {"red": 1.12, "green": 0.96, "blue": 0.71, "nir": 1.2}
    assert flown(FIELDS, WATER, FIELDS, woods, soil, WATER, FIELDS, woods) == []
    assert flown(FIELDS, {}, {"red": 0.77, "green": 0.9}, FIELDS) == []


def test_exposures_that_are_processed_in_another_order_are_compared_with_earlier_ones() -> None:
    bench, found = SequenceBench(), []
    bench.sequence._emit = lambda event, **content: found.append((event, content.get("before")))
    for number, of_bands in ((1, FIELDS), (3, HALVED), (2, HALVED), (4, HALVED)):
        figures = {f"{band}_over_pan": level for band, level in of_bands.items()}
        bench.receive(Processed(number, {"figures": figures}, {}, 1.0, {}))
    assert [step for step in found if step[0] == "band-level"] == [("band-level", 1)]
