"""Overlaps and counts follow from the rig alone: tables 1 and 2 of the paper."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    raw_from_vip_mm,
    vip_mm_from_px,
    vip_mm_from_raw,
)
from processing.geometry.topology import (
    Rectangle,
    _contains_point,
    _is_strip,
    _is_upright,
    colour_coverage,
    colour_ratio,
    common_view,
    corners,
    counts,
    footprint,
    intersection,
    outline,
    overlaps,
)
from processing.mosaic.free_mosaic import free_mosaic
from processing.rig import Rig, Sensor, find_rig, load_rig, shipped_rigs
from tests.processing.synthetic import make_truth, tie_points_of


def side_by_side_rig() -> Rig:
    """The topology of ultracam-l: two single-sensor PAN cones, left and right, and one green."""
    mini = find_rig("ultracam-x-mini")
    assert mini.virtual_image is not None
    master, other, green = mini.cone("0"), mini.cone("1"), mini.cone("G")
    half = (1248 - 128) / 2.0 * 7.2e-3
    left = dataclasses.replace(master.sensors[0], name="SU00", x_mm=-half, y_mm=0.0)
    right = dataclasses.replace(other.sensors[0], name="SU10", x_mm=half, y_mm=0.0)
    return dataclasses.replace(
        mini,
        name="side-by-side",
        cones=(
            dataclasses.replace(master, sensors=(left,)),
            dataclasses.replace(other, sensors=(right,)),
            green,
        ),
        virtual_image=dataclasses.replace(mini.virtual_image, width_px=2368, height_px=832),
    )


def test_ultracam_x_has_twelve_strips_six_of_each_kind() -> None:
    rig = find_rig("ultracam-x")
    found = overlaps(rig)
    assert len(found) == 12
    pitch = 7.2e-3
    upright = [o.rectangle for o in found if o.rectangle.height_mm > o.rectangle.width_mm]
    flat = [o.rectangle for o in found if o.rectangle.height_mm < o.rectangle.width_mm]
    assert (len(upright), len(flat)) == (6, 6)
    # 273 x 3328 and 4992 x 282, to the few pixels by which the calibrated sensors are askew.
    for r in upright:
        assert r.width_mm / pitch == pytest.approx(273, abs=8)
        assert r.height_mm / pitch == pytest.approx(3328, abs=10)
    for r in flat:
        assert r.width_mm / pitch == pytest.approx(4992, abs=10)
        assert r.height_mm / pitch == pytest.approx(282, abs=8)
    for o in found:
        assert rig.cone_of(o.sensor_a).name != rig.cone_of(o.sensor_b).name


def test_four_corners_are_seen_by_four_sensors_each() -> None:
    found = corners(find_rig("ultracam-x"))
    assert {c.sensors for c in found} == {
        ("SU00", "SU10", "SU20", "SU30"),
        ("SU01", "SU10", "SU21", "SU30"),
        ("SU02", "SU11", "SU20", "SU30"),
        ("SU03", "SU11", "SU21", "SU30"),
    }
    for corner in found:
        assert corner.rectangle.width_mm / 7.2e-3 == pytest.approx(273, abs=8)


SIXTY_FOUR = ["ultracam-d", "ultracam-x", "ultracam-xp"]
SIXTEEN = ["ultracam-l", "ultracam-lp"]


@pytest.mark.parametrize("name", [n + mini for n in SIXTY_FOUR for mini in ("", "-mini")])
def test_table_1_counts_64_parameters_12_constraints_52_unknowns(name: str) -> None:
    found = counts(find_rig(name))
    by_cone = {c.cone: (c.parameters, c.constraints, c.degrees_of_freedom) for c in found.cones}
    assert by_cone == {
        "0": (16, 4, 12),
        "1": (16, 4, 12),
        "2": (16, 4, 12),
        "3": (8, 0, 8),
        "G": (8, 0, 8),
    }
    assert (found.parameters, found.constraints, found.unknowns) == (64, 12, 52)


def test_table_2_counts_no_parameter_for_a_master_of_one_sensor_and_16_in_all() -> None:
    found = counts(side_by_side_rig())
    assert {c.cone: c.parameters for c in found.cones} == {"0": 0, "1": 8, "G": 8}
    assert (found.parameters, found.constraints) == (16, 0)


@pytest.mark.parametrize("name", [n + mini for n in SIXTEEN for mini in ("", "-mini")])
def test_table_2_holds_for_the_shipped_cameras_of_two_pan_cones(name: str) -> None:
    rig = find_rig(name)
    found = counts(rig)
    assert {c.cone: (c.parameters, c.constraints) for c in found.cones} == {
        "0": (0, 0),
        "1": (8, 0),
        "RGB": (8, 0),
    }
    assert (found.parameters, found.unknowns) == (16, 16)
    assert len(overlaps(rig)) == 1 and corners(rig) == ()
    assert colour_ratio(rig) == 2


@pytest.mark.parametrize(
    ("name", "across", "along"),
    [
        ("ultracam-d", 262, 258),
        ("ultracam-x", 273, 282),
        ("ultracam-xp", 345, 345),
        ("ultracam-l", 249, None),
        ("ultracam-lp", 296, None),
    ],
)
def test_overlaps_are_those_of_the_cameras(name: str, across: int, along: int | None) -> None:
    rig = find_rig(name)
    assert rig.virtual_image is not None
    pitch = rig.virtual_image.pitch_mm
    found = [o.rectangle for o in overlaps(rig)]
    widths = [r.width_mm / pitch for r in found if r.height_mm > r.width_mm]
    heights = [r.height_mm / pitch for r in found if r.height_mm < r.width_mm]
    # Cone rotations of the example calibrations move fields by up to 20 px.
    assert widths == pytest.approx([across] * len(widths), abs=20)
    assert heights == pytest.approx([along] * len(heights), abs=20)
    assert (len(widths), len(heights)) == ((1, 0) if along is None else (6, 6))


def test_the_virtual_image_of_every_ultracam_is_covered_by_its_sensors() -> None:
    for path in shipped_rigs().values():
        rig = load_rig(path)
        if not rig.name.startswith("ultracam"):
            continue
        image = rig.virtual_image
        assert image is not None
        placements = nominal_placements(rig, {}, {})
        c, r = np.meshgrid(
            np.linspace(8, image.width_px - 9, 60), np.linspace(8, image.height_px - 9, 60)
        )
        xy = vip_mm_from_px(image, np.stack([c.ravel(), r.ravel()], axis=1))
        seen = np.zeros(len(xy), dtype=np.bool_)
        for cone in rig.pan_cones:
            for sensor in cone.sensors:
                raw = raw_from_vip_mm(placements[sensor.name], xy)
                last = (sensor.width_px - 1, sensor.height_px - 1)
                seen |= ((raw >= 0) & (raw <= last)).all(axis=1)
        assert seen.all(), rig.name
        for cone in rig.colour_cones:
            raw = raw_from_vip_mm(placements[cone.sensors[0].name], xy)
            last = (cone.sensors[0].width_px - 1, cone.sensors[0].height_px - 1)
            assert ((raw >= 0) & (raw <= last)).all(), (rig.name, cone.name)


def test_a_camera_nobody_built_is_counted_by_the_same_rules() -> None:
    """Three PAN cones: a master of two sensors left and right, one of three, one of one."""
    mini = find_rig("ultracam-x-mini")
    master, other, third = mini.cone("0"), mini.cone("1"), mini.cone("3")
    sensor = master.sensors[0]
    step = (1248 - 128) * 7.2e-3

    def sensors(cone: str, places: list[float]) -> tuple[Sensor, ...]:
        return tuple(
            dataclasses.replace(sensor, name=f"{cone}{k}", x_mm=x * step, y_mm=0.0)
            for k, x in enumerate(places)
        )

    rig = dataclasses.replace(
        mini,
        cones=(
            dataclasses.replace(master, sensors=sensors("A", [-2.0, 2.0])),
            dataclasses.replace(other, sensors=sensors("B", [-3.0, -1.0, 1.0])),
            dataclasses.replace(third, sensors=sensors("C", [0.0])),
            mini.cone("G"),
        ),
    )
    found = counts(rig)
    assert {c.cone: (c.parameters, c.constraints) for c in found.cones} == {
        "0": (8, 4),
        "1": (20, 4),
        "3": (8, 0),
        "G": (8, 0),
    }
    assert (found.parameters, found.constraints, found.unknowns) == (44, 8, 36)
    assert {(o.sensor_a, o.sensor_b) for o in overlaps(rig)} == {
        ("A0", "B0"),
        ("A0", "B1"),
        ("A1", "B2"),
        ("B1", "C0"),
        ("B2", "C0"),
    }
    truth = make_truth(rig, np.random.default_rng(4))
    points = tie_points_of(truth, np.random.default_rng(5))
    mosaic = free_mosaic(rig, truth.start, points)
    # Only what the colour master does not see stays at its start.
    assert mosaic.rank <= 36 and mosaic.sigma0 == pytest.approx(1.0, abs=0.1)


def test_a_rig_of_two_single_sensors_has_one_strip_and_no_corner() -> None:
    rig = side_by_side_rig()
    (strip,) = overlaps(rig)
    assert (strip.sensor_a, strip.sensor_b) == ("SU00", "SU10")
    assert strip.rectangle.width_mm / 7.2e-3 == pytest.approx(128, abs=8)
    assert corners(rig) == ()


def test_green_sees_all_of_every_pan_sensor_at_a_third() -> None:
    rig = find_rig("ultracam-x")
    coverage = colour_coverage(rig)
    assert list(coverage) == [s.name for cone in rig.pan_cones for s in cone.sensors]
    assert all(r.width_mm / 7.2e-3 > 4985 for r in coverage.values())
    assert colour_ratio(rig) == 3


def test_a_rig_without_colour_master_has_neither_coverage_nor_ratio() -> None:
    rig = dataclasses.replace(find_rig("ultracam-x-mini"), colour_master_cone=None)
    assert colour_coverage(rig) == {}
    assert colour_ratio(rig) is None
    assert counts(rig).parameters == 56


def test_a_ratio_that_is_not_an_integer_is_not_rounded() -> None:
    rig = find_rig("ultracam-x-mini")
    cones = tuple(
        dataclasses.replace(c, lens=dataclasses.replace(c.lens, f_mm=21.0)) if c.name == "G" else c
        for c in rig.cones
    )
    assert colour_ratio(dataclasses.replace(rig, cones=cones)) is None


BOX = Rectangle(-2.0, 1.0, 3.0, 5.0)


def test_a_rectangle_contains_its_border() -> None:
    inside = [[-2.0, 1.0], [3.0, 5.0], [-2.0, 5.0], [3.0, 1.0], [0.0, 2.0]]
    outside = [[-2.01, 2.0], [3.01, 2.0], [0.0, 0.99], [0.0, 5.01]]
    assert BOX.contains(np.array(inside + outside)).tolist() == [True] * 5 + [False] * 4
    assert (BOX.width_mm, BOX.height_mm, BOX.empty) == (5.0, 4.0, False)
    for other in (Rectangle(3.0, 0.0, 9.0, 9.0), Rectangle(0.0, 5.0, 9.0, 9.0)):
        assert intersection(BOX, other).empty, "a common border has no area"
    assert intersection(BOX, Rectangle(2.0, -1.0, 9.0, 4.0)) == Rectangle(2.0, 1.0, 3.0, 4.0)


def test_footprints_and_outlines_reach_half_a_pixel_beyond_the_outer_pixels() -> None:
    rig = side_by_side_rig()
    for placement in nominal_placements(rig, {}, {}).values():
        w, h = placement.sensor.width_px, placement.sensor.height_px
        corners_px = raw_from_vip_mm(placement, outline(placement))
        expected = [[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]]
        np.testing.assert_allclose(corners_px, expected, atol=1e-5)
        box = footprint(placement)
        middle_x, middle_y = vip_mm_from_raw(placement, np.array([[w - 1, h - 1]]) / 2.0)[0]
        sides = np.array(
            [
                [box.x_min_mm, middle_y],
                [box.x_max_mm, middle_y],
                [middle_x, box.y_max_mm],
                [middle_x, box.y_min_mm],
            ]
        )
        found = raw_from_vip_mm(placement, sides)
        assert found[:2, 0] == pytest.approx([-0.5, w - 0.5], abs=0.05)
        assert found[2:, 1] == pytest.approx([-0.5, h - 0.5], abs=0.05)


def rotated_placement(placement: SensorPlacement, angle_deg: float, x_mm: float) -> SensorPlacement:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    layer = np.array([[c, -s, x_mm], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return dataclasses.replace(placement, layer=layer)


def test_a_tilted_sensor_shares_the_box_around_what_both_see() -> None:
    plain = nominal_placements(find_rig("ultracam-x-mini"), {}, {})["SU30"]
    upright, quarter = rotated_placement(plain, 0.0, 0.0), rotated_placement(plain, 90.0, 0.0)
    box = footprint(upright)
    common = common_view(upright, quarter)
    # A sensor turned by 90 degrees about the middle: a square of its height, to its own offset.
    side = min(box.width_mm, box.height_mm)
    assert common.width_mm == pytest.approx(side, abs=0.05)
    assert common.height_mm == pytest.approx(side, abs=0.05)
    tilted = common_view(upright, rotated_placement(plain, 45.0, 0.0))
    # The diamond's corners along y are cut by the sensor's upper and lower sides.
    assert tilted.height_mm == pytest.approx(box.height_mm, rel=0.02)
    reach = (box.width_mm + box.height_mm) / 2.0**0.5
    assert tilted.width_mm == pytest.approx(min(reach, box.width_mm), rel=0.02)
    assert common_view(upright, rotated_placement(plain, 45.0, 100.0)) == Rectangle(
        0.0, 0.0, 0.0, 0.0
    )
    # Askew by 1 % of the smaller side still counts as upright.
    for share, is_upright in ((0.9, True), (1.1, False)):
        angle = np.degrees(share * 0.01 * min(box.width_mm, box.height_mm) / box.width_mm)
        assert _is_upright(rotated_placement(plain, angle, 0.0)) is is_upright


def test_a_sensor_sees_from_its_first_pixel_centre_to_its_last() -> None:
    placement = nominal_placements(side_by_side_rig(), {}, {})["SU00"]
    last = np.array([placement.sensor.width_px - 1.0, placement.sensor.height_px - 1.0])
    inside, outside = [[0.1, 0.1], last - 0.1], [[-0.1, 5.0], [5.0, -0.1]]
    outside += [[last[0] + 0.1, 5.0], [5.0, last[1] + 0.1]]
    for at, seen in [*((p, True) for p in inside), *((p, False) for p in outside)]:
        assert _contains_point(placement, vip_mm_from_raw(placement, np.array([at]))) is seen, at


def test_a_strip_is_longer_than_half_of_the_smaller_sensor() -> None:
    sensor, larger = Rectangle(0.0, 0.0, 8.0, 4.0), Rectangle(0.0, 0.0, 10.0, 6.0)
    for width, height, strip in ((4.0, 2.0, False), (4.1, 0.1, True), (0.1, 2.1, True)):
        common = Rectangle(0.0, 0.0, width, height)
        assert _is_strip(common, sensor, larger) is strip
        assert _is_strip(common, larger, sensor) is strip


def test_converging_heads_have_three_constraints_in_common() -> None:
    rig = find_rig("dmc-mini")
    found = counts(rig)
    heads = len(rig.pan_cones)
    assert found.common_constraints == 3
    assert found.parameters - sum(c.parameters for c in found.cones) == 0
    assert [c.parameters for c in found.cones][:heads] == [3] * heads
    assert found.constraints == 3 and found.unknowns == found.parameters - 3
