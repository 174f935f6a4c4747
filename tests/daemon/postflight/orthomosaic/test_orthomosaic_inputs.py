"""Wrong ground, and triangulations of others: refused, or named with figure and cure."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.orthomosaic import OrthoFlight
from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.orientation.georeference import Georeference
from daemon.postflight.adjustment.csv_tables import write_table
from daemon.postflight.orthomosaic import triangulated
from daemon.postflight.orthomosaic.ground_check import GroundCheck, check_ground
from daemon.postflight.orthomosaic.inputs import OrthoBlock, block_for_orthomosaic
from daemon.postflight.orthomosaic.triangulated import ObjectPoints, OrthomosaicError
from daemon.postflight.triangulation.triangulation import block_of
from processing.geometry.terrain_rays import HeightModel
from processing.image.orthoimage.ground_resampling import ImagePose

pytestmark = pytest.mark.timeout(300)

RUN = CliRunner()
STEP_M = 10.0


@dataclass(frozen=True)
class Rolling:
    """Images over hills of 30 m about 400 m, and 300 tie points on them."""

    block: OrthoBlock
    points: ObjectPoints

    def model(self, height_m=lambda h: h, shift_m: float = 0.0) -> HeightModel:
        east, north = np.array([one.nadir_m for one in self.block.images]).mean(axis=0)
        x = east - 3000.0 + STEP_M * np.arange(601)
        y = north + 3000.0 - STEP_M * np.arange(601)
        heights = np.asarray(height_m(hills(*np.meshgrid(x, y))), dtype=float)
        return HeightModel(heights, x[0] + shift_m, y[0], STEP_M, -STEP_M)

    def check(self, surface: HeightModel | float, points: bool = True, **more) -> GroundCheck:
        block = self.block
        return check_ground(
            surface, block.georeference, block.frame, [one.pose for one in block.images],
            self.points if points else None, **more,
        )  # fmt: skip


def hills(east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    return 400.0 + 30.0 * np.sin(east_m / 60.0) * np.cos(north_m / 70.0)


@pytest.fixture(scope="module")
def rolling(flown: OrthoFlight) -> Rolling:
    block = block_for_orthomosaic(
        Mission.open(flown.mission), trajectory_file=flown.folder / "trajectory.csv",
        plane_height_m=400.0,
    )  # fmt: skip
    random = np.random.default_rng(5)
    nadir = np.array([one.nadir_m for one in block.images])
    at = random.uniform(nadir.min(axis=0) - 150.0, nadir.max(axis=0) + 150.0, (300, 2))
    height = hills(*at.T) + random.normal(0.0, 0.3, 300)
    geodetic = block.georeference.geodetic(np.column_stack([at, height]))
    return Rolling(block, ObjectPoints(geodetic, np.full(300, 0.3)))


def names(check: GroundCheck) -> list[str]:
    return [one.name for one in check.findings]


def sentence(check: GroundCheck) -> str:
    (found,) = check.findings
    return found.sentence


def test_the_right_model_is_silent_and_its_figures_are_stated(rolling: Rolling) -> None:
    check = rolling.check(rolling.model())
    assert check.findings == () and not check.is_wrong
    figures = check.as_json()
    assert figures["uncovered"] == 0.0 and figures["images_without_ground"] == 0
    assert abs(figures["points_above_m"]) < 0.2 and figures["points_off"] == 0.0


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda h: h - 47.0, "geoid"),
        (lambda h: h / 0.3048, "feet"),
        (lambda h: h / 1000.0, "kilometres"),
        (lambda h: h * 100.0, "centimetres"),
        (lambda h: 820.0 - 20.0 - h[::-1] + 25.0, "by other amounts"),
    ],
    ids=["datum", "feet", "kilometres", "centimetres", "other ground"],
)
def test_a_wrong_model_is_named_with_its_likely_cause(rolling: Rolling, change, word) -> None:
    check = rolling.check(rolling.model(change))
    assert names(check) == ["HEIGHT_MODEL_CONTRADICTED"] and check.is_wrong
    assert word in sentence(check)
    assert sum(w in sentence(check) for w in ("geoid", "in feet", "in kilo", "other amounts")) <= 1


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda h: h[::-1], "its rows were in reverse order"),
        (lambda h: h.T, "its rows and columns were exchanged"),
    ],
)
def test_a_model_whose_grid_is_arranged_in_another_way_is_named(
    rolling: Rolling, change, word
) -> None:
    check = rolling.check(rolling.model(change))
    assert names(check) == ["HEIGHT_MODEL_CONTRADICTED"] and check.is_wrong
    assert word in sentence(check)


def test_a_shifted_model_and_one_without_canopy_are_distinguished(rolling: Rolling) -> None:
    assert names(rolling.check(rolling.model(shift_m=200.0))) == ["GROUND_CHANGED"]
    small = rolling.check(rolling.model(lambda h: h - 2.0))
    assert names(small) == ["HEIGHT_MODEL_DIFFERS"] and not small.is_wrong
    assert "+2.0 m" in sentence(small)
    assert names(rolling.check(rolling.model(lambda h: h - 0.8))) == []


def test_ground_without_heights_is_stated_with_and_without_tie_points(rolling: Rolling) -> None:
    def holed(h: np.ndarray) -> np.ndarray:
        h = h.copy()
        h[:, : h.shape[1] // 2] = np.nan
        return h

    for points in (True, False):
        check = rolling.check(rolling.model(holed), points=points)
        assert names(check) == ["HEIGHT_MODEL_INCOMPLETE"]
        assert 0.3 < check.uncovered < 0.7, check.uncovered
        assert f"{100 * check.uncovered:.0f} %" in sentence(check)
    away = rolling.check(rolling.model(shift_m=50_000.0), points=False)
    assert away.uncovered == 1.0 and away.unseen == len(rolling.block.images)
    assert f"{away.unseen} of {away.unseen} images" in sentence(away)
    assert rolling.check(rolling.model(), points=False).findings == ()


def test_a_plane_far_from_the_tie_points_is_named(rolling: Rolling) -> None:
    assert names(rolling.check(400.0)) == []
    feet = rolling.check(400.0 / 0.3048)
    assert names(feet) == ["GROUND_HEIGHT_CONTRADICTED"] and "in feet" in sentence(feet)
    assert "--ground-height" in sentence(rolling.check(430.0))


def test_a_model_of_the_flight_that_is_not_there_is_named(rolling: Rolling, tmp_path) -> None:
    check = rolling.check(400.0, missing=tmp_path / "dtm.tif")
    assert names(check) == ["HEIGHT_MODEL_MISSING"] and "dtm.tif" in sentence(check)


def triangulation(flown: OrthoFlight, folder: Path, of: str | None = None, **changes) -> Path:
    """A triangulation whose orientations are those delivered, its rows and columns changed."""
    block = block_of(Mission.open(flown.mission), trajectory_file=flown.folder / "trajectory.csv")
    georeference = Georeference(block.crs)
    rows = []
    for eo in block.oriented:
        place = np.add(eo.centre_m, [changes.get("east_m", 0.0), 0.0, 0.0])
        latitude, longitude, _ = georeference.geodetic(
            np.array(eo.centre_m if "table_only" in changes else place)[None]
        )[0]
        row = (eo.name, *map(float, place), *map(float, eo.omega_phi_kappa_deg))
        rows.append((*row, float(latitude), float(longitude)))
    folder.mkdir()
    columns = ("image", "east_m", "north_m", "height_m", "omega_deg", "phi_deg", "kappa_deg")
    write_table(
        folder / "exterior.csv",
        f"Adjusted exterior orientation in {block.crs}, heights: {georeference.height_system}.",
        (*columns, "latitude_deg", "longitude_deg"), rows[: changes.get("rows")],
    )  # fmt: skip
    (folder / "report.json").write_text(json.dumps({"mission": of}))
    return folder


def block_with(flown: OrthoFlight, folder: Path) -> OrthoBlock:
    return block_for_orthomosaic(
        Mission.open(flown.mission), triangulation=folder, plane_height_m=400.0
    )


def test_exposures_without_orientation_are_failures(flown: OrthoFlight, tmp_path: Path) -> None:
    whole = block_with(flown, triangulation(flown, tmp_path / "whole"))
    assert whole.failures == ()
    part = block_with(flown, triangulation(flown, tmp_path / "part", rows=-2))
    count = len(whole.images)
    assert [one.exposure for one in part.failures] == [count - 1, count]
    assert "no orientation in triangulation part" in part.failures[0].cause
    done = RUN.invoke(
        app,
        ["orthomosaic", str(flown.mission), "--triangulation", str(tmp_path / "part"), "--image",
         "pan", "--bits", "8", "--gsd", "1.2", "--ground-height", "400", "--processes", "0",
         "--out", str(tmp_path / "map"), "--json"],
    )  # fmt: skip
    assert done.exit_code == 1, done.output
    assert len(json.loads(done.stdout)["failures"]) == 2


def test_a_changed_table_and_a_triangulation_of_another_mission_are_refused(
    flown: OrthoFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = triangulation(flown, tmp_path / "table", east_m=5000.0, table_only=True)
    with pytest.raises(OrthomosaicError, match="the table was changed"):
        block_with(flown, table)
    monkeypatch.setattr(Mission, "about", lambda _mission: {"id": "own"})
    block_with(flown, triangulation(flown, tmp_path / "own", of="own"))
    with pytest.raises(OrthomosaicError, match="of mission other, not of own"):
        block_with(flown, triangulation(flown, tmp_path / "other", of="other"))
    block_with(flown, triangulation(flown, tmp_path / "unnamed"))


@pytest.mark.parametrize(("away_m", "is_refused"), [(60.0, False), (5000.0, True)])
def test_orientations_are_compared_with_the_recorded_navigation(
    flown: OrthoFlight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, away_m, is_refused
) -> None:
    mission = Mission.open(flown.mission)
    recorded = triangulated.sealed_exposures(mission)
    block = block_of(mission, trajectory_file=flown.folder / "trajectory.csv")
    for eo in block.oriented:
        place = type("Place", (), {"latitude_deg": eo.latitude_deg, "longitude_deg":
                                   eo.longitude_deg})()  # fmt: skip
        recorded.results[eo.exposure] = replace(recorded.results[eo.exposure], navigation=place)
    monkeypatch.setattr(triangulated, "sealed_exposures", lambda _mission: recorded)
    folder = triangulation(flown, tmp_path / "t", east_m=away_m)
    if not is_refused:
        block_with(flown, folder)
        return
    with pytest.raises(OrthomosaicError, match="m from the positions that the flight recorded"):
        block_with(flown, folder)


def test_a_contradicted_model_ends_with_a_status_and_its_sentence(
    flown: OrthoFlight, tmp_path: Path
) -> None:
    folder = triangulation(flown, tmp_path / "t")
    block = block_with(flown, folder)
    frame = block.frame
    centres = np.array([one.pose.centre_m for one in block.images])
    low = centres - [0.0, 0.0, float(centres[:, 2].mean()) - 395.0]
    rows = [(f"t{k}", *map(float, point), 0.1, 0.1, 0.1, "3") for k, point in enumerate(low)]
    columns = ("point", "x_m", "y_m", "z_m", "sx_m", "sy_m", "sz_m", "rays")
    write_table(folder / "adjusted_points.csv", "points", columns, rows)
    place = {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg}
    (folder / "frame.json").write_text(json.dumps(place))
    out = tmp_path / "map"
    command = ["orthomosaic", str(flown.mission), "--triangulation", str(folder), "--image", "pan",
               "--bits", "8", "--gsd", "1.2", "--processes", "0", "--out", str(out)]  # fmt: skip
    done = RUN.invoke(app, [*command, "--ground-height", "300"])
    assert done.exit_code == 1 and "GROUND_HEIGHT_CONTRADICTED" in done.output, done.output
    report = json.loads((out / "orthomosaic.json").read_text())
    assert [one["name"] for one in report["findings"]] == ["GROUND_HEIGHT_CONTRADICTED"]
    assert report["ground"]["points_above_m"] > 80.0
    done = RUN.invoke(app, command)
    assert done.exit_code == 0, done.output
    assert json.loads((out / "orthomosaic.json").read_text())["findings"] == []


def test_poses_turned_by_heading_see_the_same_share(rolling: Rolling) -> None:
    """The share follows the directions of the rays, not the axes of the model."""
    model = rolling.model(lambda h: np.where(np.arange(h.shape[1]) < 300, h, np.nan))
    first = rolling.block.images[0].pose
    assert isinstance(first, ImagePose)
    flipped = replace(first, rotation=first.rotation @ np.diag([-1.0, -1.0, 1.0]))
    block = rolling.block
    shares = [
        check_ground(model, block.georeference, block.frame, [pose], None).uncovered
        for pose in (first, flipped)
    ]
    assert shares[0] == pytest.approx(shares[1], abs=0.2)
