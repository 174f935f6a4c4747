"""A mission of photographs with positions in EXIF is triangulated without attitudes."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from benchmarks.orthomosaic import owners
from daemon.cli import app
from daemon.postflight.triangulation import photograph_block
from daemon.postflight.triangulation.control_mistakes import control_mistakes, doubtful_control
from daemon.postflight.triangulation.ground_control import (
    GroundControl,
    no_control,
)
from daemon.postflight.triangulation.held_interior import free_principal_point
from daemon.postflight.triangulation.photograph_block import PhotographBlock
from daemon.postflight.triangulation.photograph_cautions import photograph_cautions
from daemon.postflight.triangulation.photograph_project import (
    photograph_project,
    photographs_section,
)
from processing.bundle.adjust import adjust
from processing.bundle.initial_values import completed
from processing.geometry.rotation import rotation_matrix
from processing.pipelines.perspective import raw_of_perspective
from processing.rig import load_rig
from tests.daemon.postflight.seneca_photographs import USED, WIDTH, needs_seneca, reduced

RUN = CliRunner()

pytestmark = needs_seneca


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for number in USED:
        reduced(number, folder)
    return folder


@pytest.fixture(scope="module")
def triangulated_block(photographs, tmp_path_factory) -> tuple[Path, dict, PhotographBlock]:
    """The mission, its report without control, and its oriented block."""
    blocks: list[PhotographBlock] = []
    mission = tmp_path_factory.mktemp("mission") / "field"
    made = RUN.invoke(
        app, ["import", "photographs", str(photographs), "--out", str(mission), "--json"]
    )
    assert made.exit_code == 0, made.output
    about = json.loads(made.stdout)
    assert about["photographs"] == len(USED)
    assert about["f_px"] == pytest.approx(2497.74 * WIDTH / 3600, rel=1e-4)
    real = photograph_block.photograph_block_of
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            photograph_block,
            "photograph_block_of",
            lambda *args, **named: blocks.append(real(*args, **named)) or blocks[-1],
        )
        done = RUN.invoke(app, ["triangulate", str(mission), "--json"])
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    return mission, json.loads(done.stdout), blocks[0]


@pytest.fixture(scope="module")
def triangulated(triangulated_block) -> tuple[Path, dict]:
    return triangulated_block[:2]


@pytest.fixture(scope="module")
def block(triangulated_block) -> PhotographBlock:
    """Adjusted without control, so that points of it as control contradict no photograph."""
    found = triangulated_block[2]
    project = photograph_project(
        found, no_control(), position_sigma_m=(3.0, 3.0, 5.0), reject_beyond=3.5
    )
    state = adjust(completed(project.network), project.settings).state
    return replace(
        found,
        block=replace(found.block, station_m=state.station, rotation=state.attitude),
        xyz_m=state.points,
        cameras=(replace(found.cameras[0], interior=state.interior[0]),),
    )


def test_photographs_are_triangulated_without_attitudes(triangulated) -> None:
    mission, report = triangulated
    found = report["photographs"]
    assert found["oriented"] == len(USED) and not found["left_out"]
    # Positions of a consumer's receiver, 24 m apart.
    assert max(found["position_rms_m"]) < 5.0
    assert max(report["triangulation"]["image_rms_px"]) < 1.0
    assert not found["f_and_height_separated"]
    assert any("not separated without control" in one for one in report["cautions"])
    folder = mission / "export" / "triangulation" / "photographs"
    assert (folder / "exterior.csv").exists() and (folder / "adjusted-rig.toml").exists()
    rows = (folder / "exterior.csv").read_text().splitlines()
    assert len([row for row in rows if row.startswith("0000")]) == len(USED)
    again = RUN.invoke(app, ["adjust", str(folder), "--json"])
    assert json.loads(again.stdout)["sigma0"] == pytest.approx(report["sigma0"], rel=0.1)


def test_an_orthomosaic_of_photographs_shows_their_pixels_where_they_are(triangulated) -> None:
    """Random pixels are projected into their photograph, and its file is read there."""
    mission, _ = triangulated
    options = ["--no-level", "--bits", "16", "--threads", "1", "--json"]
    done = RUN.invoke(app, ["orthomosaic", str(mission), *options])
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    report = json.loads(done.stdout)
    assert report["images_used"] == len(USED) and report["uncalibrated"]
    assert set(report["files"]) == {"pan-16.tif", "rgb-16.tif"}
    assert report["left_out"] == ["nir: photographs have none"]
    out = Path(report["folder"])
    with rasterio.open(out / "rgb-16.tif") as raster:
        mosaic = raster.read() / 256.0
    owner = owners(out, report)
    head = load_rig(mission / "export/triangulation/photographs/adjusted-rig.toml").cones[0]
    lines = (mission / "export/triangulation/photographs/exterior.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if line[0] != "#"))
    random = np.random.default_rng(2)
    seen, there = [], []
    for row in rows:
        number = int(row["image"][:6])
        at = np.argwhere((owner == number) & (mosaic[0] > 0))
        at = at[random.integers(0, len(at), 300)]
        first = np.array(report["first_pixel_m"])
        ground = np.column_stack([
            first + at[:, ::-1] * [report["gsd_m"], -report["gsd_m"]],
            np.full(len(at), report["ground"]["height_m"]),
        ])  # fmt: skip
        angles = (math.radians(float(row[f"{a}_deg"])) for a in ("omega", "phi", "kappa"))
        centre = np.array([float(row[f"{a}_m"]) for a in ("east", "north", "height")])
        u, v, w = rotation_matrix(*angles).T @ (ground - centre).T
        f_px = head.lens.f_mm / (head.sensors[0].pitch_um * 1e-3)
        height, width = WIDTH * 3 // 4, WIDTH
        ideal = np.column_stack([
            (width - 1) / 2 - f_px * u / w, (height - 1) / 2 + f_px * v / w,
        ])  # fmt: skip
        raw = raw_of_perspective(head, {}, ideal).astype(np.float32)
        file = next((mission / f"L0/{number:06d}").glob("*.jpg"))
        pixels = cv2.imread(str(file))[..., ::-1].astype(np.float32)
        there.append(cv2.remap(pixels, raw[None], None, cv2.INTER_LINEAR)[0])
        seen.append(mosaic[:, at[:, 0], at[:, 1]].T)
    seen, there = np.concatenate(seen), np.concatenate(there)
    for band in range(3):
        assert np.corrcoef(seen[:, band], there[:, band])[0, 1] > 0.97
    assert np.abs(np.median(seen - there, axis=0)).max() < 1.0


def test_photographs_without_a_triangulation_have_no_orthomosaic(photographs, tmp_path) -> None:
    mission = tmp_path / "mission"
    RUN.invoke(app, ["import", "photographs", str(photographs), "--out", str(mission)])
    done = RUN.invoke(app, ["orthomosaic", str(mission)])
    assert done.exit_code != 0
    assert "run syntopic triangulate first" in f"{done.output} {done.exception}"


SHIFT_M = np.array([2.0, -3.0, 25.0])
"""Of control against EXIF, such as that of heights above the geoid."""


def control_from(block: PhotographBlock, count: int, *, views: int | None = None) -> GroundControl:
    """Tie points far from each other as control, where the block has them, shifted."""
    seen = np.bincount(block.tied.point, minlength=block.tied.points)
    known = np.flatnonzero(seen >= 3)
    place = block.xyz_m[known, :2]
    chosen = [int(np.argmin(place.sum(axis=1)))]
    while len(chosen) < count:
        near = np.linalg.norm(place[:, None] - place[chosen][None], axis=2).min(axis=1)
        chosen.append(int(np.argmax(near)))
    rows = [
        (point, row)
        for point, k in enumerate(known[chosen])
        for row in np.flatnonzero(block.tied.point == k)[:views]
    ]
    at = np.array([row for _, row in rows])
    noise = np.random.default_rng(3).normal(0.0, 0.3, (len(rows), 2))
    return GroundControl(
        tuple(f"p{k}" for k in range(count)),
        ("control",) * count,
        block.xyz_m[known[chosen]] + SHIFT_M,
        np.tile((0.02, 0.02, 0.03), (count, 1)),
        block.tied.image[at],
        np.array([point for point, _ in rows]),
        block.tied.px[at] + noise,
        np.full(len(rows), 0.5),
    )


def section_of(block: PhotographBlock, control: GroundControl) -> dict:
    project = photograph_project(
        block, control, position_sigma_m=(3.0, 3.0, 5.0), reject_beyond=3.5
    )
    result = adjust(completed(project.network), project.settings)
    return photographs_section(block, control, result)


def perspective_block(block: PhotographBlock, middle_px: tuple[float, float]) -> PhotographBlock:
    """The same places seen by a camera without distortion whose principal point is elsewhere.

    Photographs are tilted by up to 20 degrees, which separates it from the attitudes.
    """
    random = np.random.default_rng(4)
    image, tied = block.block.image, block.tied
    tilt = [rotation_matrix(*random.uniform(-0.35, 0.35, 2), 0.0) for _ in block.block.names]
    level = np.array([rotation_matrix(0.0, 0.0, random.uniform(-3, 3)) for _ in tilt])
    rotation = level @ np.array(tilt)
    seen = block.xyz_m[tied.point] - block.block.station_m[tied.image]
    x, y, z = np.einsum("nji,nj->ni", rotation[tied.image], seen).T
    f_px = image.f_mm / image.pitch_mm
    col = (image.width_px - 1) / 2 + middle_px[0] - f_px * x / z
    row = (image.height_px - 1) / 2 + middle_px[1] + f_px * y / z
    px = np.column_stack([col, row]) + random.normal(0.0, 0.3, (len(x), 2))
    return replace(block, tied=replace(tied, px=px), block=replace(block.block, rotation=rotation))


@pytest.mark.parametrize("middle_px", [(0.0, 0.0), (6.0, -5.0)])
def test_a_principal_point_off_the_middle_is_named_with_what_it_does_to_f(block, middle_px) -> None:
    elsewhere = perspective_block(block, middle_px)
    project = photograph_project(
        elsewhere, no_control(), position_sigma_m=(3.0, 3.0, 5.0), reject_beyond=3.5
    )
    result = adjust(completed(project.network), project.settings)
    image = block.block.image
    (free,) = free_principal_point(result, longer_side_px=[image.width_px])
    section = photographs_section(elsewhere, no_control(), result, [free])
    assert free.point_px == pytest.approx(middle_px, abs=4 * max(free.point_sigma_px))
    named = [one for one in photograph_cautions(section) if "principal point is held" in one]
    assert bool(named) == (middle_px != (0.0, 0.0)) == section["f_depends_on_principal_point"]


@pytest.mark.parametrize(("count", "views"), [(1, None), (3, None), (3, 1)])
def test_control_shifts_the_block_against_exif(block, count, views) -> None:
    """Three points in one plane, one point alone, and points in one photograph each converge."""
    control = control_from(block, count, views=views)
    assert control_mistakes(block, control) == []
    section = section_of(block, control)
    assert section["control_points"] == count
    assert -np.array(section["position_shift_m"]) == pytest.approx(SHIFT_M, abs=3.0)
    assert max(section["position_rms_m"]) < 5.0
    assert section["principal_point_estimated"] == (count == 3 and views is None)
    assert section["f_and_height_separated"] and section["ground_sigma_of_f_m"] < 0.05


def test_control_determines_the_principal_point(block) -> None:
    elsewhere = perspective_block(block, (6.0, -5.0))
    control = control_from(elsewhere, 5)
    project = photograph_project(
        elsewhere, control, position_sigma_m=(3.0, 3.0, 5.0), reject_beyond=3.5
    )
    assert project.file.camera[0].free == ("dx0", "dy0", "df", "k1", "k2", "p1", "p2")
    result = adjust(completed(project.network), project.settings)
    (free,) = free_principal_point(result, longer_side_px=[block.block.image.width_px])
    assert free.point_px == pytest.approx((6.0, -5.0), abs=4 * max(free.point_sigma_px))
    section = photographs_section(elsewhere, control, result, [free])
    assert section["principal_point_estimated"] and section["control_rejected"] == []
    assert not any("principal point is held" in one for one in photograph_cautions(section))


def test_control_that_no_photograph_shows_separates_nothing(block) -> None:
    control = control_from(block, 3)
    none = np.zeros(0, np.int64)
    unseen = replace(control, image=none, point=none, px=control.px[:0], sigma_px=np.zeros(0))
    section = section_of(block, unseen)
    assert section["control_points"] == 0 and not section["f_and_height_separated"]
    assert section["ground_sigma_of_f_m"] > 0.1
    cautions = photograph_cautions(section)
    assert any("not measured in the block: p0, p1, p2" in one for one in cautions)


@pytest.mark.parametrize("views", [None, 1])
def test_exchanged_control_points_are_named(block, views) -> None:
    control = control_from(block, 3, views=views)
    xyz = control.xyz_m[[2, 1, 0]]
    (sentence,) = control_mistakes(block, replace(control, xyz_m=xyz))
    assert "control points p0 and p2 are exchanged" in sentence


def test_columns_for_rows_and_far_control_are_refused_with_the_reason(block) -> None:
    control = control_from(block, 4)
    (sentence,) = control_mistakes(block, replace(control, px=control.px[:, ::-1]))
    assert "columns and rows appear exchanged" in sentence
    inside = np.clip(control.px, 0, 600)
    inside[:, 1] = control.px[:, 1]
    turned = replace(control, px=inside[:, ::-1])
    assert "columns and rows" in control_mistakes(block, turned)[0]
    far = replace(control, xyz_m=control.xyz_m + np.array([0.0, 4.2e6, 0.0]))
    (sentence,) = control_mistakes(block, far)
    assert "p0 (4199.9 km)" in sentence and "order of east and north" in sentence


def test_a_wrong_control_point_is_named_where_the_adjustment_fails(block) -> None:
    control = control_from(block, 4)
    assert doubtful_control(block, control) == []
    xyz = control.xyz_m + np.array([[0, 0, 0], [0, 8.0, 0], [0, 0, 0], [0, 0, 0]])
    (sentence,) = doubtful_control(block, replace(control, xyz_m=xyz))
    assert re.search(r"p1 by [78]\.\d m;", sentence)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_control_point_that_the_adjustment_rejects_is_named(block, axis) -> None:
    """By its coordinates, or by all of its measurements."""
    control = control_from(block, 6)
    xyz = control.xyz_m.copy()
    xyz[1, axis] += 2.0
    section = section_of(block, replace(control, xyz_m=xyz))
    measurements = [
        one["point"]
        for one in section["control_measurements_rejected"]
        if one["rejected"] == one["measured"]
    ]
    assert section["control_rejected"] + measurements == ["p1"]
    assert any("rejected by the adjustment: p1" in one for one in photograph_cautions(section))


def test_a_control_point_that_all_others_contradict_is_named(block) -> None:
    control = control_from(block, 6)
    assert control_mistakes(block, control) == []
    for away in ((9.0, 0.0, 0.0), (0.0, 0.0, -9.0)):
        xyz = control.xyz_m.copy()
        xyz[2] += away
        (sentence,) = control_mistakes(block, replace(control, xyz_m=xyz))
        assert re.match(r"control point p2 is [89]\.\d m from where .* other 5 points", sentence)


def test_control_whose_measurements_are_rejected_is_named(block) -> None:
    control = control_from(block, 6)
    own = np.flatnonzero(control.point == 1)
    px = control.px.copy()
    px[own] += np.random.default_rng(6).choice([-40.0, 40.0], (len(own), 2))
    section = section_of(block, replace(control, px=px))
    (one,) = section["control_measurements_rejected"]
    assert one["point"] == "p1" and one["measured"] == len(own) and 2 * one["rejected"] >= len(own)
    expected = f"rejected by the adjustment: p1 {one['rejected']} of {len(own)};"
    assert any(expected in sentence for sentence in photograph_cautions(section))


def test_control_in_tables_is_refused_by_the_command(triangulated, block, tmp_path) -> None:
    """A gcp_list.txt in degrees with two names exchanged; the command names them."""
    mission, _ = triangulated
    control = control_from(block, 3)
    place = block.block.frame.to_geodetic(control.xyz_m[[2, 1, 0]])
    lines = ["EPSG:4326"]
    for image, point, (column, row) in zip(control.image, control.point, control.px, strict=True):
        latitude, longitude, height = place[point]
        file = block.files[block.block.names[image]]
        lines.append(
            f"{longitude:.9f} {latitude:.9f} {height:.3f} {column:.2f} {row:.2f} {file} p{point}"
        )
    path = tmp_path / "gcp_list.txt"
    path.write_text("\n".join(lines) + "\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photograph_block, "photograph_block_of", lambda *_a, **_n: block)
        done = RUN.invoke(
            app,
            ["triangulate", str(mission), "--points", str(path), "--out", str(tmp_path / "out")],
        )
    assert done.exit_code != 0
    assert "p0 and p2 are exchanged" in str(done.exception), done.output


def test_unrelated_photographs_are_reported(photographs, tmp_path) -> None:
    folder = tmp_path / "unrelated"
    folder.mkdir()
    random = np.random.default_rng(1)
    for k, number in enumerate(USED[:4]):
        noise = random.integers(0, 255, (60, 80, 3), dtype=np.uint8)
        pixels = cv2.resize(noise, (800, 600), interpolation=cv2.INTER_CUBIC)
        reduced(number, folder, pixels=pixels if k < 3 else np.full_like(pixels, 128))
    mission = tmp_path / "mission"
    assert (
        RUN.invoke(app, ["import", "photographs", str(folder), "--out", str(mission)]).exit_code
        == 0
    )
    done = RUN.invoke(app, ["triangulate", str(mission)])
    assert done.exit_code != 0
    sentence = str(done.exception)
    assert "no three photographs hang together" in sentence
    assert "little texture" in sentence and "IMG_0495.jpg 0" in sentence
    assert not (mission / "export" / "triangulation" / "photographs").exists()


def test_control_in_photographs_outside_the_block_is_named(block) -> None:
    control = replace(no_control(), unused=("IMG_9999.JPG: p1",))
    cautions = photograph_cautions(section_of(block, control))
    assert any("photographs that are not in the block: IMG_9999.JPG: p1" in one for one in cautions)
