"""The head with the least of its neighbours' fine detail, from shares given by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements
from processing.geometry.topology import overlaps
from processing.matching.tie_point_search import overlap_pixels
from processing.quality import relative_sharpness
from processing.quality.relative_sharpness import _typical, relative_sharpness_figures
from processing.rig import Sensor, find_rig

MINI = find_rig("ultracam-x-mini")
PLACEMENTS = nominal_placements(MINI, {}, {})
PAN = [s for cone in MINI.pan_cones for s in cone.sensors]
Shares = dict[str, tuple[float | None, float | None]]


def figures(
    monkeypatch: pytest.MonkeyPatch, shares: Shares, *, without: tuple[str, ...] = ()
) -> dict[str, object]:
    """Figures where these sensors have these shares of fine detail and all others 0.45."""

    def sharpness(sensor: Sensor, *_: object) -> tuple[float | None, float | None]:
        return shares.get(sensor.name, (0.45, 0.45))

    monkeypatch.setattr(relative_sharpness, "sharpness", sharpness)
    frames = {
        s.name: np.zeros((s.height_px, s.width_px), np.uint16) for s in PAN if s.name not in without
    }
    found = relative_sharpness_figures(MINI, PLACEMENTS, frames)
    content = {} if found is None else found.as_json()
    return {n: value for n, value in content.items() if not (n.startswith("noisy") and not value)}


@pytest.mark.parametrize("share", [(0.37, 0.37), (0.37, 0.45), (0.45, 0.37)])
def test_a_head_with_three_fifths_of_the_detail_is_in_order(
    monkeypatch: pytest.MonkeyPatch, share: tuple[float, float]
) -> None:
    """0.25 is a surface without detail: 0.12 of 0.2, and 0.116 of 0.2; one direction is enough."""
    assert figures(monkeypatch, {"SU10": share}) == {"blurred_sensor": None, "blurred_ratio": None}
    less = tuple(0.366 if value == 0.37 else value for value in share)
    found = figures(monkeypatch, {"SU10": (less[0], less[1])})
    assert found == {"blurred_sensor": "SU10", "blurred_ratio": pytest.approx(0.58)}


@pytest.mark.parametrize(
    ("share", "noisy"),
    [((0.6, 0.56), True), ((0.6, 0.54), False), ((0.54, 0.6), False), ((0.9, 0.95), True)],
)
def test_a_noisy_head_is_named_and_no_neighbour_of_it(
    monkeypatch: pytest.MonkeyPatch, share: tuple[float, float], noisy: bool
) -> None:
    """Its neighbours have 0.35: a third of the detail that it seems to have."""
    shares: Shares = {s.name: (0.35, 0.35) for s in PAN} | {"SU10": share}
    found = figures(monkeypatch, shares)
    assert found.get("noisy_sensor") == ("SU10" if noisy else None)
    assert (found["blurred_sensor"] is None) is noisy
    if noisy:
        assert found["noisy_share"] == pytest.approx(min(share))


def test_detail_that_the_neighbours_show_too_is_no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "noisy_sensor" not in figures(monkeypatch, {s.name: (0.6, 0.6) for s in PAN})
    nearly: Shares = {s.name: (0.47, 0.47) for s in PAN} | {"SU10": (0.6, 0.6)}
    assert "noisy_sensor" not in figures(monkeypatch, nearly)


def test_blur_of_another_head_is_named_next_to_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    shares: Shares = {"SU10": (0.9, 0.9), "SU21": (0.27, 0.27)}
    found = figures(monkeypatch, shares)
    assert found["noisy_sensor"] == "SU10" and found["blurred_sensor"] == "SU21"


def test_a_head_at_the_limit_is_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relative_sharpness, "MIN_RATIO", 0.5)
    monkeypatch.setattr(relative_sharpness, "_typical", lambda found: 0.5)
    assert figures(monkeypatch, {})["blurred_sensor"] is None


@pytest.mark.parametrize("sensor", ["SU00", "SU10", "SU30"])
def test_no_detail_at_all_is_a_thousandth(monkeypatch: pytest.MonkeyPatch, sensor: str) -> None:
    found = figures(monkeypatch, {sensor: (0.1, 0.25)})
    assert found == {"blurred_sensor": sensor, "blurred_ratio": pytest.approx(0.001 / 0.2)}


@pytest.mark.parametrize(("sharper", "found"), [(0.299, False), (0.301, True)])
def test_ground_without_detail_is_not_compared(
    monkeypatch: pytest.MonkeyPatch, sharper: float, found: bool
) -> None:
    shares: Shares = {s.name: (sharper, sharper) for s in PAN}
    shares["SU10"] = (0.26, 0.26)
    report_figures = figures(monkeypatch, shares)
    assert (
        report_figures.get("blurred_sensor") == ("SU10" if found else None)
        and bool(report_figures) == found
    )


def test_directions_and_heads_without_a_share_are_not_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert figures(monkeypatch, {s.name: (None, None) for s in PAN}) == {}
    one: Shares = {s.name: (None, 0.45) for s in PAN} | {"SU10": (0.3, 0.3)}
    assert figures(monkeypatch, one)["blurred_ratio"] == pytest.approx(0.25)
    one |= {"SU10": (0.3, None)}
    assert figures(monkeypatch, one)["blurred_sensor"] is None
    neighbours = {o.sensor_b if o.sensor_a == "SU10" else o.sensor_a for o in overlaps(MINI)}
    assert neighbours
    assert figures(monkeypatch, {"SU10": (0.3, 0.3)}, without=("SU10",)) == {
        "blurred_sensor": None,
        "blurred_ratio": None,
    }


def test_pixels_of_the_overlap_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, list[tuple[int, ...]]] = {}

    def sharpness(
        sensor: Sensor,
        frame: NDArray[np.uint16],
        rows: tuple[int, int],
        columns: tuple[int, int],
    ) -> object:
        assert frame is frames[sensor.name]
        seen.setdefault(sensor.name, []).append((*columns, *rows))
        return 0.45, 0.45

    monkeypatch.setattr(relative_sharpness, "sharpness", sharpness)
    frames = {s.name: np.zeros((s.height_px, s.width_px), np.uint16) for s in PAN}
    relative_sharpness_figures(MINI, PLACEMENTS, frames)
    for overlap in overlaps(MINI):
        for name in (overlap.sensor_a, overlap.sensor_b):
            assert [seen[name].pop(0)] == overlap_pixels(PLACEMENTS[name], [overlap])


def test_the_typical_ratio_is_the_lower_quartile_of_its_logarithm() -> None:
    assert _typical([0.1, 0.2, 0.4, 0.8, 1.6]) == pytest.approx(0.2)
    assert _typical([0.8, 0.1, 0.4, 0.2]) == pytest.approx(0.1**0.25 * 0.2**0.75)
