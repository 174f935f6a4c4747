"""`syntopic adjust` of blocks with few or no redundant observations, and of blocks too large."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from daemon.cli import app
from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import CameraSection, ProjectFile
from daemon.postflight.adjustment.project_writer import write_project
from daemon.postflight.triangulation.matching_work import match_mission_block
from daemon.postflight.triangulation.triangulation import ImageBlock
from processing.bundle import normal_equations
from processing.bundle.network import ImagePoints, NetworkError
from processing.matching.block_matching import BlockMatching
from tests.processing.bundle.simulated_networks import aerial

HELD = 3
NO_CHECKS = CheckPoints((), np.zeros((0, 3)), np.zeros((0, 3)))


def pair(folder: Path, points: int, free: tuple[str, ...] = ()) -> Path:
    """Two images of three held points and more; each more is a redundant observation."""
    block = aerial(seed=3, sigma_mm=1e-3, lines=1, along=2, points=40, control=0)
    network, table = block.network, block.network.image_points
    both = np.flatnonzero(np.bincount(table.point, minlength=40) == 2)
    across = both[np.argsort(block.points[both, 1])]
    chosen = [across[0], across[-1], across[len(across) // 2], *across[3:points]]
    own = np.isin(table.point, chosen)
    sigma, xyz = network.points.sigma_m.copy(), network.points.xyz_m.copy()
    sigma[chosen[:HELD]] = 0.0
    xyz[chosen[:HELD]] = block.points[chosen[:HELD]]
    network = replace(
        network,
        cameras=(replace(network.cameras[0], free=frozenset(free)),),
        image_points=ImagePoints(
            table.image[own], table.point[own], table.xy_mm[own], table.sigma_mm[own]
        ),
        points=replace(network.points, sigma_m=sigma, xyz_m=xyz),
    )
    file = ProjectFile(
        format=1, name="pair", camera=(CameraSection(name="c", f_mm=70.0, free=free),)
    )
    write_project(folder, file, network, NO_CHECKS)
    return folder


def run(*arguments: str) -> Result:
    outcome = CliRunner().invoke(app, ["adjust", *arguments])
    assert outcome.exception is None or isinstance(outcome.exception, SystemExit), outcome.exception
    return outcome


@pytest.mark.parametrize(("points", "free"), [(3, ()), (4, ("dx0",))])
@pytest.mark.parametrize("option", [(), ("--significance", "0.05"), ("--reject", "3")])
def test_without_redundancy_sigmas_are_dashes_and_a_sentence_gives_the_reason(
    tmp_path, points, free, option
) -> None:
    folder = pair(tmp_path / "pair", points, free)
    report = json.loads(run(str(folder), "--json", *option).stdout)
    assert report["redundancy"] == 0
    assert report["sigma0"] is None
    assert report["cautions"][0].startswith("redundancy is 0: no observation is controlled")
    printed = run(str(folder), "--out", str(tmp_path / "out"), *option)
    assert printed.exit_code == 0
    assert "sigma0 -, redundancy 0" in printed.output
    assert "redundancy is 0" in " ".join(printed.output.split())
    assert "redundancy is 0" in (tmp_path / "out" / "report.html").read_text()


def test_a_redundancy_of_one_has_no_test_and_a_sentence_gives_the_reason(tmp_path) -> None:
    folder = pair(tmp_path / "pair", 4)
    printed = run(str(folder), "--significance", "0.05", "--out", str(tmp_path / "out"))
    assert printed.exit_code == 0
    assert "limit -" in printed.output
    assert "redundancy 1 cannot test any observation" in " ".join(printed.output.split())
    tested = run(str(folder), "--significance", "0.05", "--test", "baarda")
    assert "cannot test" not in tested.output


def test_a_block_with_too_many_unknowns_ends_with_a_sentence(tmp_path, monkeypatch) -> None:
    folder = pair(tmp_path / "pair", 4)
    monkeypatch.setattr(normal_equations, "MAX_COLUMNS", 11)
    outcome = run(str(folder), "--json")
    assert outcome.exit_code == 1
    problems = json.loads(outcome.stdout)["problems"]
    assert problems[0].startswith("12 unknowns in addition to the object points; at most 11 are")
    robust = run(str(folder), "--json", "--robust")
    assert json.loads(robust.stdout)["problems"][0] == problems[0]


def test_images_that_are_too_many_are_not_matched() -> None:
    block = cast(ImageBlock, SimpleNamespace(names=tuple(f"i{k}" for k in range(25_001))))
    with pytest.raises(NetworkError, match="about 25000 exposures: split the block"):
        match_mission_block(block, BlockMatching())


def test_a_datum_without_effect_is_refused_or_reported(tmp_path) -> None:
    folder = pair(tmp_path / "pair", 4)
    project = folder / "project.toml"
    text = project.read_text()
    project.write_text(text.replace("[adjust]", '[adjust]\nfree_datum = "points"'))
    outcome = run(str(folder), "--json")
    assert outcome.exit_code == 1
    assert "set minimum_norm" in json.loads(outcome.stdout)["problems"][0]
    report = json.loads(run(str(folder), "--json", "--free-network").stdout)
    assert any("free_datum = points has no effect" in caution for caution in report["cautions"])
    project.write_text(text.replace("[adjust]", '[adjust]\ndatum_names = ["p1"]'))
    refused = CliRunner().invoke(app, ["adjust", str(folder)])
    assert isinstance(refused.exception, ProjectError)
    assert "datum_names has no effect" in str(refused.exception)


def test_polynomials_of_a_project_need_a_base_and_are_written(tmp_path) -> None:
    folder = pair(tmp_path / "pair", 8)
    project = folder / "project.toml"
    plain = project.read_text()
    project.write_text(plain.replace('name = "c"', 'name = "c"\nparameters = "ebner"'))
    refused = CliRunner().invoke(app, ["adjust", str(folder)])
    assert "set ebner needs base_mm above 0; camera c has None" in str(refused.exception)
    dropped = [f"ebner {k}" for k in range(1, 13) if k != 7]
    project.write_text(
        plain.replace(
            'name = "c"',
            f'name = "c"\nparameters = "ebner"\nbase_mm = 20.0\nwithout = {json.dumps(dropped)}',
        )
    )
    outcome = run(str(folder), "--json", "--out", str(tmp_path / "adjusted"))
    (estimated,) = json.loads(outcome.stdout)["parameters"]
    assert (estimated["name"], estimated["unit"]) == ("ebner 7", "um")
    written = (tmp_path / "adjusted" / "project.toml").read_text()
    assert "base_mm = 20.0" in written and '"ebner 7" =' in written
