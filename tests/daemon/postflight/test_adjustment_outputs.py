"""What `syntopic adjust` writes on request: covariances, a protocol, residuals by area."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import ConfigurationError
from daemon.postflight.adjustment.csv_tables import read_table
from tests.daemon.postflight.small_adjustment_block import adjusted_report, write_small_block

CAMCAL = Path(__file__).parents[2] / "processing/bundle/data/dbat-camcal/camcaldemo.xml"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A published calibration, adjusted with all outputs; its report."""
    folder = tmp_path_factory.mktemp("outputs")
    runner = CliRunner()
    imported = runner.invoke(app, ["import", "dbat", str(CAMCAL), "--out", str(folder / "project")])
    assert imported.exit_code == 0, imported.output
    outcome = runner.invoke(
        app,
        [
            "adjust", str(folder / "project"), "--json", "--out", str(folder / "out"),
            "--covariance", str(folder / "covariances.npz"), "--covariance-point", "2",
            "--covariance-point", "30", "--protocol", str(folder / "protocol.txt"),
        ],
    )  # fmt: skip
    assert outcome.exit_code == 0, outcome.output
    report: dict[str, Any] = json.loads(outcome.stdout)
    return folder, report


def test_covariances_are_those_of_parameters_and_points(written) -> None:
    folder, report = written
    with np.load(folder / "covariances.npz") as archive:
        content = {name: archive[name] for name in archive.files}
    names = list(content["unknowns"])
    assert len(names) == len(set(names)) == 21 * 6 + 9 + 2 * 3
    sigma = np.sqrt(np.diag(content["covariance"]))
    k1 = names.index("camera Olympus Camedia C4040Z k1")
    wanted = next(p["sigma"] for p in report["parameters"] if p["name"] == "k1")
    assert sigma[k1] == pytest.approx(wanted, rel=1e-9)
    assert float(content["sigma0"]) == pytest.approx(report["sigma0"])
    # The published adjustment has no chosen points: joint and single covariances are the same.
    at = [names.index(f"point 30 {axis}") for axis in "XYZ"]
    single = content["point_covariance"][list(content["points"]).index("30")]
    assert content["covariance"][np.ix_(at, at)] == pytest.approx(single, rel=1e-9)
    other = [names.index(f"point 2 {axis}") for axis in "XYZ"]
    assert np.abs(content["covariance"][np.ix_(at, other)]).max() > 0.0
    table = read_table(folder / "out" / "adjusted_points.csv", (), ("point", "x_m", "y_m", "z_m",
                       "sx_m", "sy_m", "sz_m", "rays"))  # fmt: skip
    row = table.text("point").index("45")
    every = content["point_covariance"][list(content["points"]).index("45")]
    assert np.sqrt(every[0, 0]) == pytest.approx(table.numbers("sx_m")[row], rel=1e-6)


def test_the_protocol_holds_the_published_figures_and_every_image_and_point(written) -> None:
    folder, report = written
    text = (folder / "protocol.txt").read_text()
    assert "sigma0 a posteriori       1.6148" in text
    assert "redundancy                3725" in text
    assert "principal distance 7.456995 mm" in text
    sections = text.split("\n\n")
    of = {s.splitlines()[0].split(" ", 1)[0]: s for s in sections[1:]}
    assert len(of["4"].splitlines()) == 2 + 1 + report["images"]
    assert len(of["7"].splitlines()) == 2 + 1 + report["object_points"] + 1
    assert len(of["10"].splitlines()) == 2 + 1 + 50
    assert "k2, camera Olympus Camedia C4040Z k3: -0.97" in of["12"]
    assert "station 17 Z, station 19 Z: 0.92" in of["12"]
    assert all(len(line) == len(line.rstrip()) for line in text.splitlines())


def test_the_protocol_names_all_correlations_beyond_the_limit(tmp_path) -> None:
    """A block that control points alone hold: the report names 20 of each two kinds."""
    folder = write_small_block(tmp_path / "block")
    path = folder / "project.toml"
    lines = path.read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("gnss =", "distances ="))]
    path.write_text("\n".join(kept) + "\n")
    points = folder / "points.csv"
    few = [
        line.replace(",control,", ",tie,") if line.startswith(("p3,", "p4,", "p5,", "p6,", "p7,"))
        else line
        for line in points.read_text().splitlines()
    ]  # fmt: skip
    points.write_text("\n".join(few) + "\n")
    report = adjusted_report(folder, "--protocol", str(tmp_path / "protocol.txt"))
    groups = report["correlations"]["groups"]
    assert any(g["count"] > len(g["largest"]) for g in groups)
    sections = (tmp_path / "protocol.txt").read_text().split("\n\n")
    (listed,) = [s for s in sections if s.startswith("12 Correlations beyond 0.9")]
    assert len(listed.splitlines()) == 2 + sum(1 + g["count"] for g in groups)
    assert "not listed" not in listed


def test_correlations_and_areas_are_in_the_report(written) -> None:
    folder, report = written
    groups = report["correlations"]["groups"]
    assert groups[0]["first_kind"] == "camera"
    assert report["correlations"]["count"] == sum(g["count"] for g in groups)
    cells = report["areas"]["cells"]
    assert sum(c["count"] for c in cells) == report["image_points"]
    # The corners of the held control points do not fit: published, and seen at once.
    worst = max(cells, key=lambda c: c["rms_um"])
    assert worst["rms_um"] > 2.0 * np.median([c["rms_um"] for c in cells])
    page = (folder / "out" / "report.html").read_text()
    assert page.count("<svg") == 3


def test_a_point_without_a_file_for_it_and_a_point_that_is_not_there_are_refused(
    written, tmp_path
) -> None:
    project = str(written[0] / "project")
    runner = CliRunner()
    alone = runner.invoke(app, ["adjust", project, "--covariance-point", "2"])
    assert isinstance(alone.exception, ConfigurationError)
    target = tmp_path / "c.npz"
    unknown = runner.invoke(
        app, ["adjust", project, "--covariance", str(target), "--covariance-point", "x", "--json"]
    )
    assert unknown.exit_code == 1
    assert "covariances of x: no object points" in json.loads(unknown.stdout)["problems"][0]
    assert not target.exists()
