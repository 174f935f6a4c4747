"""Control and check points compared with the block of a flight: right ones, and wrong tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daemon.mission.layout import Mission
from daemon.onboard.triangulation import control_points
from daemon.onboard.triangulation.control_points import (
    ControlPointsError,
    PointResidual,
    control_findings,
    control_json,
    read_measurements,
    read_surveyed,
    residuals_of,
)
from daemon.onboard.triangulation.live_record import write_live
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.exterior_orientation import sealed_exposures
from processing.bundle.measured_points import measured_point, projected_mm
from processing.geometry.rotation import rotations_from_vectors
from tests.daemon.flown_block import ground_points, write_points

POINTS = 24


@pytest.fixture(scope="module")
def tables(flown, tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("tables")
    return write_points(folder, flown, ground_points(flown, POINTS, 7))


@pytest.fixture(scope="module")
def done(flown, tables) -> MissionTriangulation:
    folder = Mission.open(flown.mission)
    result = MissionTriangulation(folder, control=tables[0], measured=tables[1])
    read = sealed_exposures(folder).results
    for number in sorted(read):
        result.add(read[number])
    result.land()
    return result


def _names(residuals) -> set[str]:
    return {finding.name for finding in control_findings(residuals)}


def _changed(path: Path, folder: Path, change) -> Path:
    """A copy of a table whose rows are changed."""
    head, *rows = path.read_text().splitlines()
    out = folder / path.name
    out.write_text("\n".join([head, *(",".join(change(row.split(","))) for row in rows)]))
    return out


def _residuals(done, points: Path, measured: Path | None = None) -> tuple[PointResidual, ...]:
    surveyed = read_surveyed(points)
    seen = None if measured is None else read_measurements(measured, surveyed.names)
    return residuals_of(done.live, done.frame, surveyed, seen)


def test_measured_points_differ_as_their_covariance_states(done) -> None:
    found = done.residuals
    assert len(found) == POINTS and not done.findings
    difference = np.array([one.difference_m for one in found])
    sigma = np.array([one.sigma_m for one in found])
    assert (np.abs(difference) < 4.5 * sigma).all()
    assert (np.abs(difference[:, :2]) < 0.25).all() and (sigma[:, :2] < 0.1).all()
    assert {one.role for one in found} == {"control", "check"}
    assert all(one.rays >= 3 for one in found)
    # Measured to 0.1 px; the rest is what the block is off by.
    assert 0.1 < max(one.image_px for one in found) < 1.5
    write_live(done)
    page = (done.folder / "report.html").read_text()
    assert "block minus survey" in page and "P003, control" in page


def test_without_image_coordinates_heights_are_compared_with_the_tie_points(done, tables) -> None:
    found = _residuals(done, tables[0])
    known = [one for one in found if one.difference_m[2] is not None]
    assert len(known) >= POINTS // 2 and not control_findings(found)
    for one in known:
        assert one.difference_m[:2] == (None, None) and one.rays == 0
        assert abs(one.difference_m[2]) < 4.5 * one.sigma_m[2] < 5.0
    assert all(one.reason for one in found if one not in known)
    summary = control_json(found)
    assert summary["in_plan"] == 0 and summary["rms_m"][0] is None
    assert summary["rms_m"][2] == pytest.approx(
        np.sqrt(np.mean([one.difference_m[2] ** 2 for one in known]))
    )


def test_heights_above_the_geoid_contradict_the_block(done, tables, tmp_path) -> None:
    lower = _changed(tables[0], tmp_path, lambda r: [*r[:4], f"{float(r[4]) - 47.0:.4f}"])
    for measured in (None, tables[1]):
        found = _residuals(done, lower, measured)
        (finding,) = control_findings(found)
        assert finding.name == "CONTROL_CONTRADICTED"
        median = float(finding.sentence.split("lies ")[1].split(" m")[0])
        assert median == pytest.approx(47.0, abs=1.0)


def test_swapped_coordinates_are_not_in_the_block(done, tables, tmp_path) -> None:
    swapped = _changed(tables[0], tmp_path, lambda r: [*r[:2], r[3], r[2], r[4]])
    assert _names(_residuals(done, swapped)) == {"CONTROL_NOT_IN_BLOCK"}
    assert _names(_residuals(done, swapped, tables[1])) == {"CONTROL_CONTRADICTED"}


def test_coordinates_of_other_images_contradict_the_block(done, tables, tmp_path) -> None:
    shifted = _changed(tables[1], tmp_path, lambda r: [f"{int(r[0]) % 10 + 1:06d}", *r[1:]])
    assert "CONTROL_CONTRADICTED" in _names(_residuals(done, tables[0], shifted))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "it is empty"),
        ("point,role,latitude_deg,longitude_deg\n", "no column height_m"),
        ("point,role,latitude_deg,longitude_deg,height_m\n", "it has no point"),
        ("point,role,latitude_deg,longitude_deg,height_m\nA,checks,1,2,3\n", "line 2: role"),
        ("point,role,latitude_deg,longitude_deg,height_m\nA,check,91,2,3\n", "out of range"),
        ("point,role,latitude_deg,longitude_deg,height_m\nA,check,1,2,nan\n", "height_m is 'nan'"),
        ("point,role,latitude_deg,longitude_deg,height_m\nA,check,1,2\n", "4 cells for 5"),
        (
            "point,role,latitude_deg,longitude_deg,height_m\nA,check,1,2,3\nA,check,1,2,3\n",
            "line 3: point 'A' is empty or given twice",
        ),
        ("point,role,latitude_deg,longitude_deg,height_m,sz_m\nA,check,1,2,3,-1\n", "sigma"),
    ],
)
def test_a_wrong_table_of_points_names_its_mistake(tmp_path, text, sentence) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(ControlPointsError, match=sentence):
        read_surveyed(path)


def test_hostile_bytes_and_a_missing_table_are_a_finding_and_the_flight_goes_on(
    flown, tmp_path
) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(bytes(range(256)))
    for given in (path, tmp_path / "absent.csv"):
        result = MissionTriangulation(Mission.open(flown.mission), control=given)
        result.add(sealed_exposures(result.mission).results[1])
        result.land()
        (finding,) = [f for f in result.findings if f.name == "CONTROL_NOT_READ"]
        assert given.name in finding.sentence


def test_measurements_name_their_mistakes(tmp_path) -> None:
    path = tmp_path / "measured.csv"
    path.write_text("image,point,column_px,row_px,sigma_px\n1,B,2,3,0\nx,A,2,3,1\n")
    with pytest.raises(ControlPointsError, match="line 2: point 'B'") as caught:
        read_measurements(path, ("A",))
    assert "sigma_px is positive" in str(caught.value) and "image is 'x'" in str(caught.value)


def test_a_point_moves_with_the_orientations_as_its_gain_states() -> None:
    random = np.random.default_rng(3)
    station = np.array([[0.0, 0.0, 900.0], [300.0, 20.0, 905.0], [40.0, 350.0, 895.0]])
    rotation = rotations_from_vectors(random.normal(0.0, 0.05, (3, 3)))
    place, f_mm, image = np.array([120.0, 90.0, 12.0]), 100.0, np.arange(3)
    xy = projected_mm(f_mm, station, rotation, place)
    sigma = np.array([0.001, 0.002, 0.001])
    found = measured_point(f_mm, station, rotation, image, xy, sigma)
    assert found.xyz_m == pytest.approx(place, abs=1e-7)
    for column in range(18):
        one, axis = divmod(column, 6)
        moved, turned, step = station.copy(), rotation.copy(), 1e-4 if axis < 3 else 1e-7
        if axis < 3:
            moved[one, axis] += step
        else:
            turned[one] = (
                rotation[one] @ rotations_from_vectors(step * np.eye(3)[None, axis - 3])[0]
            )
        again = measured_point(f_mm, moved, turned, image, xy, sigma)
        numeric = (again.xyz_m - place) / step
        assert found.gain[:, column] == pytest.approx(numeric, rel=1e-3, abs=2e-3)
    drawn = np.array(
        [
            measured_point(
                f_mm,
                station,
                rotation,
                image,
                xy + random.normal(0.0, sigma[:, None], (3, 2)),
                sigma,
            ).xyz_m
            for _ in range(400)
        ]
    )
    spread = np.linalg.eigvals(np.linalg.solve(found.noise, np.cov(drawn.T))).real
    assert spread.min() > 0.75 and spread.max() < 1.3
    assert measured_point(f_mm, station, rotation, np.zeros(2, np.int64), xy[:2], sigma[:2]) is None
    up = np.array([place[0], place[1], 2000.0])
    assert np.isnan(projected_mm(f_mm, station, rotation, up)).all()


def test_rough_ground_around_a_point_is_in_the_standard_deviation_of_its_height() -> None:
    random = np.random.default_rng(2)
    drawn, stated = [], []
    for _ in range(200):
        ties = np.column_stack([random.uniform(-80.0, 80.0, (40, 2)), np.zeros(40)])
        ties[:, 2] = 0.05 * ties[:, 0] + random.normal(0.0, 2.0, 40)
        place = np.array([0.0, 0.0, random.normal(0.0, 2.0)])
        sigma = np.full((40, 3), 0.1)
        found = control_points._by_surface("A", "check", place, ties, sigma, 0.02, 1000.0)
        if not found.reason:  # the nearest lie all around it
            drawn.append(found.difference_m[2])
            stated.append(found.sigma_m[2])
    assert len(drawn) > 150
    assert np.sqrt(np.mean(np.square(drawn))) == pytest.approx(
        np.sqrt(np.mean(np.square(stated))), rel=0.15
    )
    assert control_points._by_surface(
        "A", "check", np.array([500.0, 0.0, 0.0]), ties, sigma, 0.02, 1000.0
    ).reason.startswith("0 tie points")
