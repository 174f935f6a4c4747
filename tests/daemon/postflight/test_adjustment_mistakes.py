"""`syntopic adjust` with mistakes in a project: each ends in one sentence with file and line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import ConfigurationError
from daemon.postflight.adjustment.csv_tables import ProjectError, read_table, write_table
from daemon.postflight.adjustment.project_writer import RESIDUAL_COLUMNS
from daemon.postflight.adjustment.reliability_report import OBSERVATION_COLUMNS
from tests.daemon.postflight.small_adjustment_block import adjusted_report as _report
from tests.daemon.postflight.small_adjustment_block import changed_cell as _cell
from tests.daemon.postflight.small_adjustment_block import write_small_block


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small block with GNSS positions and a distance."""
    return write_small_block(tmp_path_factory.mktemp("mistakes") / "block")


def _scaled(factor: float) -> Callable[[str], str]:
    both = [_cell(-1, c, lambda v: repr(float(v) * factor)) for c in ("x_mm", "y_mm")]
    return lambda text: both[1](both[0](text))


def _repeated(text: str) -> str:
    return text + text.splitlines()[-1] + "\n"


def _repeated_off(text: str) -> str:
    image, point, _, _, *rest = text.splitlines()[-1].split(",")
    return text + ",".join([image, point, "5.0", "-5.0", *rest]) + "\n"


def _copied(text: str) -> str:
    lines = text.splitlines()
    first, second = lines[-40].split(","), lines[-39].split(",")
    lines[-39] = ",".join([second[0], *first[1:]])
    return "\n".join(lines) + "\n"


def _emptied(text: str) -> str:
    return "\n".join(text.splitlines()[:2]) + "\n"


MISTAKES = {
    "pixels": ("image_points.csv", _scaled(200.0), "are these pixels"),
    "metres": ("image_points.csv", _scaled(1e-3), "are these metres?"),
    "repeated": ("image_points.csv", _repeated, "a second time (line "),
    "repeated with a gross error": ("image_points.csv", _repeated_off, "a second time (line "),
    "no image points": ("image_points.csv", _emptied, "no rows"),
    "no image sigma": ("image_points.csv", _cell(4, "sx_um", lambda _: "0"), "sx_um is 0;"),
    "no GNSS sigma": ("gnss.csv", _cell(1, "sz_m", lambda _: "-0.1"), "sz_m is -0.1;"),
    "no distance sigma": (
        "distances.csv",
        _cell(0, "sigma_m", lambda _: "0"),
        "sigma_m is 0;",
    ),
    "to itself": (
        "distances.csv",
        _cell(0, "point_b", lambda _: "p10"),
        "from p10 to itself",
    ),
    "no distance": (
        "distances.csv",
        _cell(0, "distance_m", lambda _: "0"),
        "distance_m is 0;",
    ),
    "identical": ("points.csv", _copied, "has the coordinates of "),
    "semicolons": (
        "points.csv",
        lambda text: text.replace(",", ";"),
        "separated by semicolons; write commas",
    ),
    "tabulators": ("points.csv", lambda text: text.replace(",", "\t"), "separated by tabulators"),
    "decimal comma": (
        "points.csv",
        _cell(0, "x_m", lambda v: v.replace(".", ",")),
        "write decimals with points",
    ),
    "remark": (
        "image_points.csv",
        _cell(3, "image", lambda v: f"#{v}"),
        "looks like a name",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_with_file_and_line(mistake, written, tmp_path) -> None:
    name, change, sentence = MISTAKES[mistake]
    folder = shutil.copytree(written, tmp_path / "block")
    path = folder / name
    path.write_text(change(path.read_text()))
    outcome = CliRunner().invoke(app, ["adjust", str(folder)])
    assert isinstance(outcome.exception, ProjectError), outcome.output
    (problem,) = outcome.exception.problems
    assert problem.startswith(f"{name}:")
    assert problem.split(":")[1].isdigit()
    assert sentence in problem


def test_a_byte_order_mark_changes_nothing(written, tmp_path) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    plain = CliRunner().invoke(app, ["adjust", str(folder), "--json"])
    for path in folder.iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    outcome = CliRunner().invoke(app, ["adjust", str(folder), "--json"])
    assert json.loads(outcome.stdout)["sigma0"] == json.loads(plain.stdout)["sigma0"]


def test_a_principal_distance_of_zero_is_refused_with_its_line(written, tmp_path) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    path = folder / "project.toml"
    path.write_text(path.read_text().replace("f_mm = 70.0", "f_mm = 0.0"))
    outcome = CliRunner().invoke(app, ["adjust", str(folder)])
    assert isinstance(outcome.exception, ProjectError), outcome.output
    (problem,) = outcome.exception.problems
    assert problem.startswith("project.toml:")
    assert "f_mm is 0.0; it is more than 0" in problem


def test_the_global_test_and_a_control_point_without_images_are_reported(written, tmp_path) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    report = json.loads(CliRunner().invoke(app, ["adjust", str(folder), "--json"]).stdout)
    low, high = report["global_test"]["limits"]
    assert low < report["sigma0"] < high
    assert report["global_test"]["passed"] is True
    assert report["cautions"] == []
    path = folder / "image_points.csv"
    rows = [line for line in path.read_text().splitlines() if line.split(",")[1:2] != ["p2"]]
    path.write_text("\n".join(rows) + "\n")
    report = json.loads(CliRunner().invoke(app, ["adjust", str(folder), "--json"]).stdout)
    assert report["cautions"] == ["1 control points have no image point: p2"]


def test_sigmas_of_another_unit_fail_the_global_test(written, tmp_path) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    path = folder / "image_points.csv"
    change = _cell(-1, "sx_um", lambda value: repr(float(value) * 1e-3))
    path.write_text(change(path.read_text()))
    report = json.loads(CliRunner().invoke(app, ["adjust", str(folder), "--json"]).stdout)
    assert report["global_test"]["passed"] is False
    first, second, *_ = report["cautions"]
    assert "a sigma may be of another unit" in first
    assert second.startswith("image x: the variance factor is ")


@pytest.mark.parametrize(
    ("table", "change"),
    [
        ("image_points.csv", _cell(-1, "y_mm", lambda v: repr(-float(v)))),
        ("image_points.csv", lambda text: text.replace("x_mm,y_mm", "y_mm,x_mm")),
    ],
)
def test_mirrored_coordinates_are_named_with_the_sigma0_they_would_have(
    table, change, written, tmp_path
) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    # Attitudes are found from the control, wherever the images turn.
    (folder / table).write_text(change((folder / table).read_text()))
    for name in ("x_m", "y_m", "z_m", "omega_deg", "phi_deg", "kappa_deg"):
        path = folder / "exposures.csv"
        path.write_text(_cell(-1, name, lambda _: "")(path.read_text()))
    outcome = CliRunner().invoke(app, ["adjust", str(folder), "--json"])
    answer = json.loads(outcome.stdout)
    found = [s for s in [*answer.get("cautions", ()), *answer["problems"]] if "mirrored" in s]
    assert len(found) == 1, answer
    assert float(found[0].rsplit(" ", 1)[1]) == pytest.approx(_report(written)["sigma0"], abs=1e-3)


def test_a_good_block_with_a_blunder_names_no_reversed_axis(written, tmp_path) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    path = folder / "image_points.csv"
    path.write_text(_cell(7, "x_mm", lambda v: repr(float(v) + 3.0))(path.read_text()))
    report = _report(folder)
    assert report["sigma0"] > 20.0
    assert not any("mirrored" in one for one in report["cautions"][1:])
    seen = read_table(path, ("image", "point"), ("x_mm", "y_mm", "sx_um", "sy_um"))
    image, point = seen.text("image")[7], seen.text("point")[7]
    assert f"blunders: without point {point} in image {image} sigma0 is " in report["cautions"][-1]


def test_a_name_that_begins_with_a_hash_is_read_back_as_it_was_written(tmp_path) -> None:
    path = tmp_path / "t.csv"
    rows = [("#12", 1.0), ('#a"b,c', 2.0), ("d", 3.0)]
    write_table(path, "a remark", ("name", "value"), rows)
    back = read_table(path, ("name", "value"), ())
    assert back.text("name") == ["#12", '#a"b,c', "d"]
    assert back.numbers("value") == [1.0, 2.0, 3.0]


def test_the_limit_of_a_significance_and_reliability_are_reported_and_written(
    written, tmp_path
) -> None:
    out = tmp_path / "adjusted"
    report = _report(written, "--significance", "0.05", "--test", "baarda", "--out", str(out))
    found = report["reliability"]
    assert found["test"] == "baarda"
    assert 50 < found["tests"] < report["observations"]
    assert 3.5 < found["limit"] < 4.5
    of_kind = {g["name"]: g for g in found["groups"]}
    assert set(of_kind) >= {"image x", "image y", "GNSS plan", "control plan", "distance"}
    assert 3.0 < of_kind["image y"]["detectable_median"] < 30.0
    table = read_table(out / "residuals.csv", (), (*RESIDUAL_COLUMNS,))
    values = np.array(table.numbers("detectable_y_um"))
    assert np.nanmedian(values) == pytest.approx(of_kind["image y"]["detectable_median"], rel=1e-3)
    others = read_table(out / "observations.csv", OBSERVATION_COLUMNS, ())
    assert "distance p10 to p11" in others.text("observation")
    assert "Baarda" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--reject", "4", "--significance", "0.05"), "both set the limit"),
        (("--weight-function", "best"), "huber, cauchy, tukey or danish"),
        (("--test", "t"), "pope or baarda"),
        (("--free-datum", "camera"), "points, stations, all or dependent"),
        (("--free-datum", "points", "--no-free-network"), "leave out --no-free-network"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, sentence, written) -> None:
    outcome = CliRunner().invoke(app, ["adjust", str(written), *options])
    assert isinstance(outcome.exception, ConfigurationError)
    assert sentence in str(outcome.exception)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1 / 0.3048, "may be in feet"),
        (1000.0, "in millimetres"),
        (1e-3, "in kilometres"),
        (2.0, "one of them is of another unit"),
    ],
)
def test_control_of_another_unit_is_named_with_the_ratio(factor, words, written, tmp_path) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    path = folder / "points.csv"
    lines = path.read_text().splitlines()
    for k, line in enumerate(lines):
        cells = line.split(",")
        if cells[1:2] == ["control"]:
            cells[2:5] = [repr(float(v) * factor) for v in cells[2:5]]
            lines[k] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    outcome = CliRunner().invoke(app, ["adjust", str(folder), "--json"])
    answer = json.loads(outcome.stdout)
    found = [s for s in [*answer.get("cautions", ()), *answer["problems"]] if "as far apart" in s]
    assert len(found) == 1, answer
    assert words in found[0]
    assert float(found[0].split()[3]) == pytest.approx(factor, rel=0.01)


@pytest.mark.parametrize(("count", "words"), [(1, "is the only control"), (2, "are the only")])
def test_one_or_two_control_points_are_one_sentence(count, words, written, tmp_path) -> None:
    folder = shutil.copytree(written, tmp_path / "block")
    project = folder / "project.toml"
    text = project.read_text().splitlines()
    project.write_text("\n".join(t for t in text if "gnss =" not in t and "distances =" not in t))
    path = folder / "points.csv"
    lines, left = path.read_text().splitlines(), count
    for k, line in enumerate(lines):
        cells = line.split(",")
        if cells[1:2] == ["control"]:
            if not left:
                cells[1:2], cells[5:8] = ["tie"], ["", "", ""]
            left -= bool(left)
            lines[k] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    outcome = CliRunner().invoke(app, ["adjust", str(folder), "--json"])
    (problem,) = json.loads(outcome.stdout)["problems"]
    assert problem.startswith("p0 " if count == 1 else "p0 and p1 ")
    assert words in problem
