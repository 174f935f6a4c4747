"""Overlaps are those of rectangles laid out by hand, in whatever order the flight is processed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.configuration.model import MountSection
from daemon.mission.exposure import Exposure, NavigationRecord
from daemon.mission.layout import Mission
from daemon.planning.model import LocalPlane, Point
from daemon.planning.overlaps import (
    Overlaps,
    OverlapShares,
    _samples,
    _visible,
    overlaps_of,
)
from processing.quality.nominal_area import nominal_area
from processing.rig import find_rig

RIG = find_rig("ultracam-x-mini")
HEIGHT_M, GROUND_M = 3000.0, 400.0
assert RIG.virtual_image is not None
SCALE = HEIGHT_M / RIG.virtual_image.f_mm * RIG.virtual_image.pitch_mm
ALONG_M, ACROSS_M = RIG.virtual_image.height_px * SCALE, RIG.virtual_image.width_px * SCALE
PLANE = LocalPlane(Point(47.0, 15.0))


def exposure(number: int, line: str, east_m: float, north_m: float, heading: float) -> Exposure:
    place = PLANE.place(east_m, north_m)
    navigation = NavigationRecord(
        receiver="gnss",
        gps_ns=0,
        method="interpolated",
        fix="3d",
        latitude_deg=place.latitude_deg,
        longitude_deg=place.longitude_deg,
        height_m=HEIGHT_M + GROUND_M,
        horizontal_sigma_m=0.1,
        vertical_sigma_m=0.1,
        velocity_ned_mps=(60.0, 0.0, 0.0),
        speed_sigma_mps=0.1,
        roll_rad=0.0,
        pitch_rad=0.0,
        heading_rad=math.radians(heading),
    )
    return Exposure(number=number, line_id=line, navigation=navigation)


def overlaps_with(*exposures: Exposure) -> Overlaps:
    overlaps = Overlaps(RIG, MountSection(), GROUND_M)
    for one in exposures:
        overlaps.add(one)
    return overlaps


def test_forward_overlap_is_what_the_image_before_on_the_line_saw() -> None:
    flown = [exposure(k + 1, "a", 0.0, 0.4 * ALONG_M * k, 0.0) for k in range(2)]
    flown.append(exposure(3, "a", 0.0, 1.2 * ALONG_M, 0.0))
    overlaps = overlaps_with(*flown)
    assert overlaps.of(1).forward_overlap is None
    assert overlaps.of(2).forward_overlap == pytest.approx(0.6, abs=0.025)
    # One is missing in between.
    assert overlaps.of(3).forward_overlap == pytest.approx(0.2, abs=0.025)


def test_an_image_off_all_lines_or_of_another_line_is_no_neighbour_ahead() -> None:
    overlaps = overlaps_with(
        exposure(1, "a", 0.0, 0.0, 0.0),
        exposure(2, "", 0.0, 0.2 * ALONG_M, 0.0),
        exposure(3, "b", 0.0, 0.4 * ALONG_M, 0.0),
        exposure(4, "a", 0.0, 0.4 * ALONG_M, 0.0),
    )
    assert overlaps.of(2).forward_overlap is None
    assert overlaps.of(3).forward_overlap is None
    assert overlaps.of(4).forward_overlap == pytest.approx(0.6, abs=0.025)


@pytest.mark.parametrize("spacing", [0.7, 0.9, 1.2])
def test_sidelap_is_what_the_neighbouring_line_saw_flown_either_way(spacing: float) -> None:
    there = [exposure(k + 1, "a", 0.0, 0.4 * ALONG_M * k, 0.0) for k in range(6)]
    back = [
        exposure(7 + k, "b", spacing * ACROSS_M, 0.4 * ALONG_M * (5.3 - k), 180.0) for k in range(5)
    ]
    overlaps = overlaps_with(*there, *back)
    assert overlaps.of(3).sidelap is None
    for number in (8, 9, 10, 11):
        assert overlaps.of(number).sidelap == pytest.approx(max(0.0, 1 - spacing), abs=0.025)


def test_between_two_lines_the_poorer_side_counts() -> None:
    left = [exposure(k + 1, "a", 0.0, 0.4 * ALONG_M * k, 0.0) for k in range(3)]
    right = [exposure(k + 4, "c", 1.45 * ACROSS_M, 0.4 * ALONG_M * k, 0.0) for k in range(3)]
    middle = exposure(7, "b", 0.7 * ACROSS_M, 0.4 * ALONG_M, 0.0)
    assert overlaps_with(*left, *right, middle).of(7).sidelap == pytest.approx(0.25, abs=0.025)


def test_figures_do_not_depend_on_what_came_later() -> None:
    flown = [exposure(k + 1, "a", 0.0, 0.4 * ALONG_M * k, 0.0) for k in range(3)]
    flown += [exposure(k + 4, "b", 0.7 * ACROSS_M, 0.4 * ALONG_M * k, 0.0) for k in range(3)]
    in_order, at_once = Overlaps(RIG, MountSection(), GROUND_M), overlaps_with(*flown)
    for one in flown:
        in_order.add(one)
        assert in_order.of(one.number) == at_once.of(one.number)


def test_without_a_line_or_an_attitude_nothing_is_stated() -> None:
    navigation = exposure(1, "a", 0, 0, 0).navigation
    assert navigation is not None
    blind = Exposure(number=1, line_id="a", navigation=replace(navigation, roll_rad=None))
    overlaps = overlaps_with(blind, Exposure(number=2, line_id="a"))
    assert overlaps.of(1) == overlaps.of(2) == overlaps.of(99)


def test_a_record_that_cannot_be_read_costs_its_own_overlap_only(tmp_path: Path) -> None:
    for number in (1, 2):
        (tmp_path / f"L0/{number:06d}").mkdir(parents=True)
    (tmp_path / "L0/000001/exposure.json").write_bytes(b'{"number": 1, ')
    (tmp_path / "service.toml").write_text("[plan]\nground_height_m = 400.0\n")
    assert overlaps_of(Mission(tmp_path, tmp_path.name), RIG).of(1) == OverlapShares()


def test_an_image_sees_nothing_in_its_gaps_and_nothing_beyond_its_border() -> None:
    image = replace(
        overlaps_with(exposure(1, "a", 0.0, 0.0, 0.0))._seen[1],
        area=nominal_area(RIG, ["SU11"]),
    )
    (band, *_) = image.area.gaps
    there = _samples(image.corners)
    seen = _visible(image, there, band)
    assert float(seen.mean()) == pytest.approx(image.area.share(band), abs=0.05)
    assert 0.0 < float(seen.mean()) < 1.0
    assert not _visible(image, there + 3.0 * ACROSS_M, band).any()
