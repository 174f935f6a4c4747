"""The project that `syntopic adjust --out` writes: adjusted again, it has the same result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.project import CheckPoints, read_project
from daemon.postflight.adjustment.project_file import (
    AdjustmentHeadSection,
    AdjustSection,
    CameraSection,
    ProjectFile,
)
from daemon.postflight.adjustment.project_writer import write_project
from processing.bundle.network import Distances, HeadMounting, MeasuredAttitudes
from tests.processing.bundle.simulated_networks import aerial
from tests.processing.bundle.test_forward_models import FISHEYE, PLAIN
from tests.processing.bundle.test_forward_models import _block as forward_block

NO_CHECKS = CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A block with blunders in image points, control, GNSS, attitudes and distances, and priors."""
    sigma = {"df": 0.002, "dx0": 0.002}
    block = aerial(
        seed=3,
        sigma_mm=1e-3,
        points=80,
        gnss_sigma_m=0.05,
        heads=(HeadMounting("h", np.eye(3), np.array([0.2, 0.1, 0.0])),),
    )
    network, n = block.network, len(block.network.stations.names)
    xy = network.image_points.xy_mm.copy()
    xy[40] += 0.3
    xyz = network.points.xyz_m.copy()
    xyz[2, 0] += 3.0
    position = block.station + block.attitude @ np.array([0.2, 0.1, 0.0])
    antenna = position + np.random.default_rng(1).normal(0.0, 0.05, position.shape)
    antenna[3, 2] += 8.0
    rotation = block.attitude.copy()
    turned = 0.05
    rotation[5] = rotation[5] @ np.array(
        [[np.cos(turned), -np.sin(turned), 0], [np.sin(turned), np.cos(turned), 0], [0, 0, 1]]
    )
    ends = np.array([[20, 30], [40, 41], [22, 33]])
    lengths = np.linalg.norm(block.points[ends[:, 0]] - block.points[ends[:, 1]], axis=1)
    lengths[1] += 9.0
    # The measured offset is 5 mm off: its observation and the adjusted value differ.
    head = HeadMounting(
        "h", np.eye(3), np.array([0.205, 0.1, 0.0]), offset_free=True, offset_sigma_m=0.01
    )
    network = replace(
        network,
        cameras=(replace(network.cameras[0], free=frozenset(sigma), sigma=sigma),),
        heads=(head,),
        image_points=replace(network.image_points, xy_mm=xy),
        points=replace(network.points, xyz_m=xyz),
        gnss=replace(network.gnss, position_m=antenna),
        distances=Distances(ends[:, 0], ends[:, 1], lengths, np.full(3, 0.05)),
        measured_attitudes=MeasuredAttitudes(
            np.arange(n), rotation, np.tile([1e-3, 1e-3, 2e-3], (n, 1))
        ),
    )
    file = ProjectFile(
        format=1,
        name="block",
        adjust=AdjustSection(),
        camera=(CameraSection(name="c", f_mm=70.0, free=tuple(sigma), sigma=sigma),),
        head=(
            AdjustmentHeadSection(name="h", x_m=0.205, y_m=0.1, offset="free", offset_sigma_m=0.01),
        ),
    )
    target = tmp_path_factory.mktemp("adjusted") / "block"
    write_project(target, file, network, NO_CHECKS)
    return target


def report_of(*arguments: str) -> dict[str, Any]:
    outcome = CliRunner().invoke(app, ["adjust", *arguments, "--json"])
    assert outcome.exception is None, outcome.output
    report: dict[str, Any] = json.loads(outcome.stdout)
    return report


def test_the_adjusted_project_has_the_same_result_without_options(folder, tmp_path) -> None:
    out = tmp_path / "out"
    first = report_of(str(folder), "--robust", "--reject", "5", "--out", str(out))
    kinds = {name.split(" ")[0] for name in first["excluded"]}
    assert first["rejected"]
    assert kinds == {"control", "GNSS", "attitude", "distance"}
    again = report_of(str(out), "--out", str(tmp_path / "again"))
    assert again["sigma0"] == pytest.approx(first["sigma0"], rel=1e-6)
    assert again["redundancy"] == first["redundancy"]
    assert again["rejected"] == again["excluded"] == []
    # Parameters observed with a sigma were observed once, with the given value.
    for one, two in zip(first["parameters"], again["parameters"], strict=True):
        assert two["value"] == pytest.approx(one["value"], abs=1e-3 * one["sigma"])
        assert abs(one["value"]) > 0.01 * one["sigma"]
    assert again["heads"][0]["offset_m"] == pytest.approx(first["heads"][0]["offset_m"], abs=1e-6)
    settings = read_project(out / "project.toml").settings
    assert settings.robust
    assert settings.reject_beyond == 5.0
    # And a second time: what is unused stays so.
    third = report_of(str(tmp_path / "again"))
    assert third["sigma0"] == pytest.approx(first["sigma0"], rel=1e-6)
    assert third["redundancy"] == first["redundancy"]


def test_sigmas_of_attitudes_differ_by_axis(folder) -> None:
    sigma = read_project(folder / "project.toml").network.measured_attitudes.sigma_rad
    assert sigma[0] == pytest.approx([1e-3, 1e-3, 2e-3])


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("gnss.csv", "the antenna position of exposure e7 is observed a second time (line "),
        ("attitudes.csv", "the attitude of exposure e7 is observed a second time (line "),
        ("distances.csv", "the distance between p22 and p33 is observed a second time (line "),
    ],
)
def test_a_repeated_observation_is_refused_with_file_and_line(
    folder, tmp_path, name, sentence
) -> None:
    block = copy_of(folder, tmp_path)
    path = block / name
    last = path.read_text().splitlines()[-1]
    if name == "distances.csv":
        ends = last.split(",")
        last = ",".join([ends[1], ends[0], *ends[2:]])
    path.write_text(path.read_text() + last + "\n")
    (problem,) = problems_of(block)
    assert problem.startswith(f"{name}:")
    assert sentence in problem


@pytest.mark.parametrize(
    "name", ["exposures.csv", "points.csv", "gnss.csv", "attitudes.csv", "distances.csv"]
)
def test_a_table_with_names_of_columns_only_is_refused(folder, tmp_path, name) -> None:
    block = copy_of(folder, tmp_path)
    (block / name).write_text("\n".join((block / name).read_text().splitlines()[:2]) + "\n")
    assert f"{name}:2: no rows; remove the table from [files]" in "\n".join(problems_of(block))


@pytest.mark.parametrize(
    ("name", "column", "cell", "sentence"),
    [
        ("gnss.csv", "sz_m", "", "sz_m is empty; a sigma, or unused, is right"),
        ("gnss.csv", "z_m", "", "an antenna position needs three coordinates"),
        ("attitudes.csv", "sy_deg", "-1", "sy_deg is -1; a sigma is positive"),
        ("distances.csv", "sigma_m", "x", "sigma_m is 'x'; a number is right"),
    ],
)
def test_a_cell_that_cannot_be_used_is_one_sentence(
    folder, tmp_path, name, column, cell, sentence
) -> None:
    block = copy_of(folder, tmp_path)
    lines = (block / name).read_text().splitlines()
    header = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    cells = lines[-1].split(",")
    cells[lines[header].split(",").index(column)] = cell
    (block / name).write_text("\n".join([*lines[:-1], ",".join(cells)]) + "\n")
    found = problems_of(block)
    assert found[0] == f"{name}:{len(lines)}: {sentence}"


def copy_of(folder: Path, tmp_path: Path) -> Path:
    target = tmp_path / "copy"
    target.mkdir()
    for path in folder.iterdir():
        (target / path.name).write_bytes(path.read_bytes())
    return target


def problems_of(block: Path) -> tuple[str, ...]:
    outcome = CliRunner().invoke(app, ["adjust", str(block)])
    problems: tuple[str, ...] = getattr(outcome.exception, "problems", ())
    return problems


def test_a_fisheye_camera_is_adjusted_from_its_project(tmp_path: Path) -> None:
    network, _ = forward_block("fisheye", FISHEYE * PLAIN, 1e-3)
    camera = network.cameras[0]
    section = CameraSection(name="c", f_mm=camera.f_mm, model="fisheye", free=tuple(camera.free))
    file = ProjectFile(format=1, name="fisheye", camera=(section,))
    write_project(tmp_path / "p", file, network, NO_CHECKS)
    done = CliRunner().invoke(app, ["adjust", str(tmp_path / "p"), "--json"])
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    k1 = next(p for p in report["parameters"] if p["name"] == "k1")
    assert k1["unit"] == "1" and abs(k1["value"] - FISHEYE[3]) < 5.0 * k1["sigma"]
    assert report["sigma0"] == pytest.approx(1.0, abs=0.1)
