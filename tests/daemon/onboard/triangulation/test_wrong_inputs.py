"""Wrong inputs of a flight: each is named with what to do, or stays within what is stated."""

from __future__ import annotations

import copy
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from daemon.mission.layout import Mission
from daemon.onboard.live_orthomosaic.map_ground import ModelGround
from daemon.onboard.monitoring.server_messages import message_of
from daemon.onboard.triangulation.findings import (
    BlockTies,
    TriangulationFinding,
    findings_of,
)
from daemon.onboard.triangulation.heading_check import headings_off
from daemon.onboard.triangulation.height_model_check import HeightModelCheck, check_heights
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from daemon.orientation.local_frame import LocalFrame
from processing.geometry.rotation import rotations_from_vectors
from processing.geometry.terrain_rays import HeightModel
from processing.pipelines.live_triangulation import MeasuredImage
from tests.daemon.flown_block import read_record, write_record
from tests.daemon.onboard.conftest import EACH, LINES

Change = Callable[[MeasuredImage], MeasuredImage]
SHUFFLED = (1, 3, 2, 5, 4, 7, 6, 8, 10, 9)
SWAPPED_DEG = 40.0


def _added(mission: Path, numbers: tuple[int, ...]) -> MissionTriangulation:
    folder = Mission.open(mission)
    done = MissionTriangulation(folder)
    read = sealed_exposures(folder).results
    for number in numbers:
        done.add(read[number])
    return done


@pytest.fixture(scope="module")
def added(flown) -> MissionTriangulation:
    """All exposures, in the order that is left after a resync, before landing."""
    return _added(flown.mission, SHUFFLED)


def _with(added: MissionTriangulation, change: Change) -> MissionTriangulation:
    """Landed with other measured orientations and the same matches."""
    done = copy.deepcopy(added)
    done.live.images = [change(one) for one in done.live.images]
    done.land()
    return done


def _names(done: MissionTriangulation) -> set[str]:
    return {one.name for one in done.findings}


def test_exposures_in_another_order_make_the_same_block(added) -> None:
    done = _with(added, lambda one: one)
    assert done.findings == () and len(done.live.last_images) == EACH * LINES
    assert all(one.source == "block" for one in done.live.orientations)


def test_a_clock_that_steps_is_named(added) -> None:
    def stepped(one: MeasuredImage) -> MeasuredImage:
        late_s = 0.02 if one.number > EACH + 2 else 0.0
        return replace(one, position_m=one.position_m + late_s * one.velocity_mps)

    done = _with(added, stepped)
    found = {f.name: f.sentence for f in done.findings}
    assert "clock" in found.get("GNSS_CONTRADICTED", "") or "TIME_OFFSET" in found


def test_a_mirrored_lever_arm_is_named_with_its_cure(added) -> None:
    """The antenna is 0.6 m to the right, configured to the left."""
    aside = np.array([1.2, 0.0, 0.0])
    done = _with(added, lambda one: replace(one, position_m=one.position_m + one.rotation @ aside))
    sentences = {f.name: f.sentence for f in done.findings}
    assert "antenna_m" in sentences["BORESIGHT_CHANGED"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_drift_of_a_hundredth_of_a_degree_a_minute_is_named_or_within_its_sigma(
    added, axis
) -> None:
    begin_s = min(one.time_s for one in added.live.images)

    def drifted(one: MeasuredImage) -> MeasuredImage:
        vector = np.zeros((1, 3))
        vector[0, axis] = math.radians(0.01) * (one.time_s - begin_s) / 60.0
        return replace(one, rotation=one.rotation @ rotations_from_vectors(vector)[0])

    done = _with(added, drifted)
    (drift,) = [d for d in done.drifts if f"camera's {'xyz'[axis]} per hour" in d.name]
    assert abs(drift.value - 600.0) < 3.5 * drift.sigma
    if drift.sigma < 600.0 / 5.0:
        assert "ATTITUDE_DRIFT" in _names(done)


def test_a_heading_of_swapped_sign_is_named(flown, tmp_path) -> None:
    """As on lines of an azimuth of 20 degrees: neighbours are predicted aside, and nothing ties."""
    mission = tmp_path / "mission"
    shutil.copytree(flown.mission, mission)
    numbers = tuple(range(1, EACH + 1))
    for number in numbers:
        record = read_record(mission, number)
        record["navigation"]["heading_rad"] += math.radians(SWAPPED_DEG)
        write_record(mission, record)
    done = _added(mission, numbers)
    done.land()
    (finding,) = [f for f in done.findings if f.name == "HEADING_CONTRADICTED"]
    assert "sign" in finding.sentence and len(finding.exposures) >= 3
    assert "UNTIED_EXPOSURES" in _names(done)


def _image(number: int, east: float, north: float, heading_deg: float, line: str):
    angle = math.radians(heading_deg)
    forward = np.array([math.sin(angle), math.cos(angle), 0.0])
    right = np.array([forward[1], -forward[0], 0.0])
    rotation = np.column_stack([right, forward, [0.0, 0.0, 1.0]])
    return line, float(number), np.array([east, north, 1000.0]), rotation


def _off(*images: tuple[str, float, np.ndarray, np.ndarray]) -> np.ndarray:
    lines, times, positions, rotations = zip(*images, strict=True)
    return headings_off(lines, np.array(times), np.array(positions), np.array(rotations))


def test_headings_are_compared_with_the_direction_of_flight() -> None:
    north = [_image(k, 0.0, 100.0 * k, 10.0, "A") for k in range(4)]
    east = [_image(9 + k, 100.0 * k, 50.0, 85.0, "B") for k in range(3)]
    assert not _off(*north, *east).any()
    # A swapped sign: lines to the north do not show it, lines across them point backwards.
    swapped = [_image(9 + k, 100.0 * k, 50.0, -85.0, "B") for k in range(3)]
    assert np.abs(_off(*north, *swapped)).tolist() == [0.0] * 4 + [180.0] * 3
    # A camera across the flight is a mounting, in whatever order the exposures came.
    across = [_image(k, 0.0, 100.0 * k, 95.0, "A") for k in (2, 0, 3, 1)]
    assert not _off(*across).any()
    oblique = [_image(k, 36.0 * k, 100.0 * k, -20.0, "A") for k in range(3)]
    assert _off(*oblique) == pytest.approx(-39.8, abs=0.1)
    assert not _off(_image(0, 0.0, 0.0, 33.0, "A")).any()


def _ties(**changed: object) -> BlockTies:
    numbers = (1, 2, 3, 4)
    ties = BlockTies(numbers, ("A",) * 4, (0, 1, 2, 40), ((40, 1),) * 3 + ((40, 30),), {}, None)
    return replace(ties, **changed)


def _found(ties: BlockTies, heights: HeightModelCheck | None = None) -> dict[str, str]:
    found: tuple[TriangulationFinding, ...] = findings_of(ties, (), skipped={}, heights=heights)
    return {one.name: one.sentence for one in found}


def test_a_wrong_heading_is_named_only_where_nothing_ties() -> None:
    found = _found(_ties(headings_off_deg=(70.0, 72.0, 74.0, 70.0)))
    assert "Exposures 1-3" in found["UNTIED_EXPOSURES"]
    assert "exposures 1-3 do not fit" in found["HEADING_CONTRADICTED"]
    assert "72 degrees" in found["HEADING_CONTRADICTED"]
    assert "HEADING_CONTRADICTED" not in _found(_ties(headings_off_deg=(0.0, 0.0, 0.0, 90.0)))


def _check(off_m: np.ndarray) -> HeightModelCheck:
    """Tie points that lie that far from a level model at 300 m."""
    return _against(300.0 + off_m, lambda en: np.full(len(en), 300.0))


def _tied() -> BlockTies:
    return _ties(ties=(40,) * 4, own_line=((40, 30),) * 4)


def _against(height_m: np.ndarray, heights_at, at_m=None) -> HeightModelCheck:
    frame = LocalFrame(47.0, 15.0)
    relief = SimpleNamespace(
        system=SimpleNamespace(
            place=lambda latitude, longitude, height: SimpleNamespace(
                east_m=longitude, north_m=latitude, height_m=height
            )
        ),
        model=heights_at,
    )
    count = len(height_m)
    xyz = np.column_stack([np.zeros((count, 2)) if at_m is None else at_m, height_m])
    return check_heights(relief, frame, xyz, np.full((count, 3), 0.3))


def test_a_height_model_of_another_datum_or_of_other_ground_is_named() -> None:
    random = np.random.default_rng(1)
    fits = random.normal(0.0, 0.5, 200)
    tied = _ties(ties=(40,) * 4, own_line=((40, 30),) * 4)
    assert _found(tied, _check(fits)) == {}
    datum = _found(tied, _check(fits + 40.0))
    assert (
        "+40." in datum["HEIGHT_MODEL_CONTRADICTED"]
        and "geoid" in datum["HEIGHT_MODEL_CONTRADICTED"]
    )
    pit = fits.copy()
    pit[:40] -= 25.0
    assert (
        "20 % of the tie points lie more than 5.0 m" in _found(tied, _check(pit))["GROUND_CHANGED"]
    )
    few = fits.copy()
    few[:10] += 25.0
    assert _found(tied, _check(few)) == {}


@pytest.mark.parametrize("unit", [(3.2808, "feet"), (0.001, "kilometres"), (100.0, "centimetres")])
def test_a_height_model_in_another_unit_is_named(unit: tuple[float, str]) -> None:
    factor, name = unit
    random = np.random.default_rng(1)
    points = 300.0 + random.normal(0.0, 0.5, 200)
    check = _against(points, lambda en: np.full(len(en), 300.0 * factor))
    found = _found(_tied(), check)["HEIGHT_MODEL_CONTRADICTED"]
    assert f"in {name}" in found and "geoid" not in found
    message = message_of(found)
    assert message is not None and message["code"].endswith("height_unit")


@pytest.mark.parametrize(
    ("arranged", "sentence"),
    [
        (lambda z: z[::-1], "its rows were in reverse order"),
        (lambda z: z[:, ::-1], "its columns were in reverse order"),
        (lambda z: z[::-1, ::-1], "turned by 180 degrees"),
        (lambda z: z.T, "its rows and columns were exchanged"),
        (lambda z: np.rot90(z, 1), "turned by 90 degrees to the left"),
        (lambda z: np.rot90(z, -1), "turned by 90 degrees to the right"),
        (lambda z: z[::-1, ::-1].T, "exchanged and reversed"),
    ],
)
def test_a_height_model_whose_grid_is_arranged_in_another_way_is_named(arranged, sentence) -> None:
    """Some have nearly the median height of the ground, and differ by no limit in the median."""
    random = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 61), np.linspace(1.0, -1.0, 61))
    ground = 300.0 + 12.0 * np.sin(3.0 * x) + 9.0 * np.cos(2.0 * y + x) + 5.0 * x * y
    # 500 m and more to each side of the frame's origin, in the degrees that the system returns.
    half = 0.007
    places = random.uniform(-500.0, 500.0, (200, 2))
    frame = LocalFrame(47.0, 15.0)
    first = frame.to_geodetic(np.column_stack([places, np.full(200, 300.0)]))

    def model(heights: np.ndarray) -> HeightModel:
        step = 2.0 * half / 60.0
        return HeightModel(heights, 15.0 - half, 47.0 + half, step, -step)

    points = model(ground).at(first[:, [1, 0]]) + random.normal(0.0, 0.4, 200)
    assert np.isfinite(points).all()
    right = _against(points, model(ground), places)
    assert right.arrangement == "" and right.scatter_m < 1.0
    check = _against(points, model(arranged(ground)), places)
    found = _found(_tied(), check)["HEIGHT_MODEL_CONTRADICTED"]
    assert sentence in found and check.arranged_m < 1.0 < check.scatter_m
    message = message_of(found)
    assert message is not None and message["code"].endswith("height_arrangement")
    # Ground without relief fits however the model is arranged.
    assert _against(np.full(200, 300.0), model(np.full_like(ground, 300.0)), places).scatter_m < 0.1
    # A model that fits in no arrangement is of other ground.
    other = _against(points, model(300.0 + random.normal(0.0, 20.0, ground.shape)), places)
    assert other.arrangement == ""


def test_tie_points_without_a_height_in_the_model_are_counted() -> None:
    half = np.arange(200) % 2 == 0
    heights = iter(np.where(half, np.nan, 300.0))
    check = _against(np.full(200, 300.2), lambda en: np.array([next(heights) for _ in en]))
    assert check.uncovered == pytest.approx(0.5)
    found = _found(_tied(), check)
    assert list(found) == ["HEIGHT_MODEL_INCOMPLETE"]
    assert "50 % of the tie points" in found["HEIGHT_MODEL_INCOMPLETE"]
    message = message_of(found["HEIGHT_MODEL_INCOMPLETE"])
    assert message is not None and message["code"].endswith("height_incomplete")
    few = iter(np.where(np.arange(200) < 3, np.nan, 300.0))
    assert (
        _found(_tied(), _against(np.full(200, 300.2), lambda en: np.array([next(few) for _ in en])))
        == {}
    )
    assert "HEIGHT_MODEL_FAILED" in _found(
        _tied(), _against(np.full(200, 300.2), lambda en: np.full(len(en), np.nan))
    )


def test_lines_left_before_their_end_are_named_after_landing() -> None:
    def found(has_landed: bool) -> list[TriangulationFinding]:
        return list(
            findings_of(
                _tied(), (), skipped={}, planned_lines=("A", "B"), missing_at_ends={"A": 3},
                has_landed=has_landed,
            )
        )  # fmt: skip

    assert found(has_landed=False) == []
    ends, whole = found(has_landed=True)
    assert ends.name == whole.name == "PLAN_CUT_SHORT"
    assert ends.lines == ("A",) and whole.lines == ("B",)
    assert "3 planned exposures at the ends of lines A have no image" in ends.sentence
    message = message_of(ends.sentence)
    assert message is not None and message["code"].endswith("plan_short_ends")


def test_the_live_map_states_which_share_of_tie_points_its_model_has_no_height_for() -> None:
    ground = ModelGround(SimpleNamespace(), 0.4567)
    assert ground.as_json() == {"kind": "height model", "uncovered": 0.457}
    # Another share alone is no other ground: no tile is sent again for it.
    assert ground == ModelGround(ground.relief, 0.2) != ModelGround(SimpleNamespace(at=1), 0.4567)
