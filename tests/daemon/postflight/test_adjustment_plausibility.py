"""`syntopic adjust` names rows that vanish, what counts twice, and sigmas that do not fit."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.csv_tables import ProjectError
from tests.daemon.postflight.small_adjustment_block import (
    adjusted_report,
    changed_cell,
    write_small_block,
)

Change = Callable[[str], str]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_block(tmp_path_factory.mktemp("plausible") / "block")


def changed(written: Path, tmp_path: Path, changes: dict[str, list[Change]]) -> Path:
    folder = shutil.copytree(written, tmp_path / "block")
    for name, steps in changes.items():
        path = folder / name
        for step in steps:
            path.write_text(step(path.read_text()))
    return folder


def problems_of(folder: Path) -> tuple[str, ...]:
    outcome = CliRunner().invoke(app, ["adjust", str(folder)])
    assert isinstance(outcome.exception, ProjectError), outcome.output
    return outcome.exception.problems


def to(value: str) -> Change:
    return lambda _: value


def every(columns: tuple[str, ...], value: str) -> list[Change]:
    return [changed_cell(-1, column, to(value)) for column in columns]


def of_control(columns: tuple[str, ...], value: str) -> list[Change]:
    """Tie points have empty cells, which stay so."""
    return [changed_cell(-1, column, lambda v: value if v else "") for column in columns]


def replaced(old: str, new: str) -> Change:
    def step(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return step


def image_twice(text: str) -> str:
    rows = [line for line in text.splitlines() if line.startswith("0-0,")]
    return text + "".join(row.replace("0-0,", "dup,", 1) + "\n" for row in rows)


def point_twice(text: str) -> str:
    rows = [line for line in text.splitlines() if ",p2," in line]
    assert len(rows) >= 2
    return text + "".join(row.replace(",p2,", ",p2b,") + "\n" for row in rows)


SIGMAS = ("sx_m", "sy_m", "sz_m")

REFUSED: dict[str, tuple[dict[str, list[Change]], str]] = {
    "name with underscore": (
        {"points.csv": [changed_cell(2, "point", to("#_2"))]},
        "points.csv:5: '#_2' looks like a name",
    ),
    "two marks": (
        {"gnss.csv": [changed_cell(3, "exposure", to("##e3"))]},
        "gnss.csv:6: '##e3' looks like a name",
    ),
    "image under two names": (
        {
            "images.csv": [lambda text: text + "dup,c,e0,,,,\n"],
            "image_points.csv": [image_twice],
        },
        "image dup has the coordinates of image 0-0 in 17 of 17 common points",
    ),
    "coordinates twice": (
        {"image_points.csv": [replaced("x_mm,y_mm,sx_um", "x_mm,y_mm,y_mm")]},
        "image_points.csv:2: columns ['y_mm'] are named twice",
    ),
    "sigmas twice": (
        {"points.csv": [replaced("sx_m,sy_m", "sx_m,sx_m")]},
        "points.csv:2: columns ['sx_m'] are named twice",
    ),
    "underscore in a number": (
        {"points.csv": [changed_cell(0, "x_m", to("1_24.25"))]},
        "points.csv:3: x_m is '1_24.25'; a number is right",
    ),
    "full-width digits": (
        {"points.csv": [changed_cell(0, "x_m", to("\uff1124.25"))]},
        "points.csv:3: x_m is '\uff1124.25'; a number is right",
    ),
    "infinite sigma": (
        {"gnss.csv": [changed_cell(0, "sx_m", to("inf"))]},
        "gnss.csv:3: sx_m is 'inf'; a number is right",
    ),
    "tiny sigma of control": (
        {"points.csv": [changed_cell(0, "sx_m", to("1e-300"))]},
        "points.csv:3: sx_m is 1e-300, too small for coordinates that extend over 1008 m; write 0",
    ),
    "huge sigma of control": (
        {"points.csv": [changed_cell(0, "sx_m", to("1e6"))]},
        "points.csv:3: sx_m is 1e+06, too large for coordinates that extend over 1008 m; leave",
    ),
    "tiny sigma of GNSS": (
        {"gnss.csv": [changed_cell(0, "sx_m", to("1e-300"))]},
        "gnss.csv:3: sx_m is 1e-300, too small for coordinates",
    ),
    "huge sigma of image coordinates": (
        {"image_points.csv": [changed_cell(0, "sx_um", to("1e300"))]},
        "image_points.csv:3: sx_um is 1e+300, too large for image coordinates",
    ),
    "tiny sigma of a distance": (
        {"distances.csv": [changed_cell(0, "sigma_m", to("1e-12"))]},
        "distances.csv:3: sigma_m is 1e-12, too small for a distance of 302.506 m",
    ),
    "control beyond Earth": (
        {"points.csv": [changed_cell(0, "x_m", to("1e300"))]},
        "points.csv:3: x_m is 1e+300; coordinates are within 1e+08 m",
    ),
    "antenna beyond Earth": (
        {"gnss.csv": [changed_cell(0, "x_m", to("1e308"))]},
        "gnss.csv:3: x_m is 1e+308; coordinates are within 1e+08 m",
    ),
    "ground beyond Earth": (
        {"project.toml": [replaced("[adjust]", "[adjust]\nground_m = 1e9")]},
        "project.toml:5: adjust.ground_m is 1000000000.0; it is at most 20000",
    ),
    "unknown parameter": (
        {"project.toml": [replaced("f_mm = 70.0", 'f_mm = 70.0\nfree = ["df", "zz"]')]},
        "['zz'] are not among dx0, dy0, df",
    ),
    "pixels without pitch": (
        {"image_points.csv": [replaced("x_mm,y_mm", "column_px,row_px")]},
        "camera c: pixel coordinates need pixel_um, width_px and height_px",
    ),
    "no images": (
        {"images.csv": [lambda text: "\n".join(text.splitlines()[:2]) + "\n"]},
        "images.csv:2: no rows; add a row for each of the images",
    ),
}


@pytest.mark.parametrize("mistake", REFUSED)
def test_what_cannot_be_right_is_one_sentence(mistake, written, tmp_path) -> None:
    changes, sentence = REFUSED[mistake]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        (problem,) = problems_of(changed(written, tmp_path, changes))
    assert sentence in problem


def test_a_good_block_has_no_caution_and_ends_with_status_0(written) -> None:
    assert adjusted_report(written)["cautions"] == []


@pytest.mark.parametrize("seed", range(1, 9))
def test_sigmas_that_are_right_cause_no_caution(seed, tmp_path) -> None:
    folder = write_small_block(tmp_path / "block", seed=seed)
    cautions = adjusted_report(folder)["cautions"]
    assert not [sentence for sentence in cautions if "no image point" not in sentence]


@pytest.mark.parametrize("row", ["# 0-0,p7,19.4,17.9,1.0,1.0", "#0-0,p7,19.4,17.9,1.0"])
def test_rows_left_out_as_remarks_are_stated_with_their_lines(row, written, tmp_path) -> None:
    def insert(text: str) -> str:
        return "\n".join([*text.splitlines()[:5], row, *text.splitlines()[5:], ""])

    folder = changed(written, tmp_path, {"image_points.csv": [insert]})
    (caution,) = adjusted_report(folder)["cautions"]
    assert caution.startswith("image_points.csv: 1 lines that begin with # contain a comma")
    assert "(line 6)" in caution


def test_a_point_under_two_names_is_a_caution_with_both(written, tmp_path) -> None:
    folder = changed(written, tmp_path, {"image_points.csv": [point_twice]})
    (caution,) = adjusted_report(folder)["cautions"]
    assert (
        "1 object points have the coordinates of another one, and count twice: p2b as p2" in caution
    )


def test_remarks_without_a_comma_and_before_the_names_are_no_rows(written, tmp_path) -> None:
    steps = [lambda text: "# written by hand, twice\n" + text + "# the end\n"]
    assert adjusted_report(changed(written, tmp_path, {"points.csv": steps}))["cautions"] == []


def test_equal_coordinates_of_few_points_of_other_images_are_no_repetition(
    written, tmp_path
) -> None:
    """Whole pixels agree by chance in some of many points."""
    rounded = [
        changed_cell(-1, c, lambda v: repr(round(float(v) / 8.0) * 8.0)) for c in ("x_mm", "y_mm")
    ]
    folder = changed(written, tmp_path, {"image_points.csv": rounded})
    assert CliRunner().invoke(app, ["adjust", str(folder)]).exit_code == 1
    assert not isinstance(CliRunner().invoke(app, ["adjust", str(folder)]).exception, ProjectError)


SUSPICIOUS: dict[str, tuple[dict[str, list[Change]], tuple[str, ...]]] = {
    "control in millimetres": (
        {"points.csv": of_control(SIGMAS, "20")},
        (
            "control plan: the variance factor is 5.21e-05, outside ",
            "the sigma of 20 m states, 0.144 m would fit. Is the sigma of another unit?",
            "control height: the variance factor is ",
        ),
    ),
    "GNSS far too good": (
        {"gnss.csv": every(SIGMAS, "1e-6")},
        ("24 standard deviations of antenna positions are below 0.0001 m, the smallest 1e-06 m",),
    ),
    "all a thousand times too large": (
        {
            "image_points.csv": every(("sx_um", "sy_um"), "1000"),
            "points.csv": of_control(SIGMAS, "20"),
            "gnss.csv": every(SIGMAS, "50"),
            "distances.csv": every(("sigma_m",), "10"),
        },
        ("image x: the variance factor is 8.5", "the sigma of 1000 um states, 0.923 um would fit"),
    ),
    "GNSS heights off": (
        {"gnss.csv": [changed_cell(-1, "z_m", lambda v: repr(float(v) + 0.5))]},
        ("GNSS height: the variance factor is 12.2, outside ", "has this kind a systematic error?"),
    ),
    "image sigma in millimetres": (
        {"image_points.csv": every(("sx_um", "sy_um"), "0.001")},
        ("the sigma of 0.001 um states, 0.919 um would fit",),
    ),
}


@pytest.mark.parametrize("mistake", SUSPICIOUS)
def test_a_sigma_that_does_not_fit_is_named_with_that_which_would(
    mistake, written, tmp_path
) -> None:
    changes, sentences = SUSPICIOUS[mistake]
    cautions = "\n".join(adjusted_report(changed(written, tmp_path, changes))["cautions"])
    for sentence in sentences:
        assert sentence in cautions


UNORIENTED = every(("x_m", "y_m", "z_m", "omega_deg", "phi_deg", "kappa_deg"), "")

EXPLAINED: dict[str, tuple[dict[str, list[Change]], tuple[str, ...]]] = {
    "Y and Z of control": (
        {"points.csv": [replaced("y_m,z_m", "z_m,y_m")]},
        ("columns y_m and z_m of the control points are exchanged",),
    ),
    "control in a circle": (
        {"points.csv": [replaced("x_m,y_m,z_m", "y_m,z_m,x_m")]},
        ("columns x_m, y_m and z_m of the control points are exchanged",),
    ),
    "control without orientations": (
        {"points.csv": [replaced("y_m,z_m", "z_m,y_m")], "exposures.csv": UNORIENTED},
        ("the control points are mirrored against the image points: two of their columns",),
    ),
    "principal distance off by 1.4 %": (
        {"project.toml": [replaced("f_mm = 70.0", "f_mm = 71.0")]},
        ("the principal distance is wrong: estimated, it is 70 mm (f_mm 71) and sigma0 is 1.01",),
    ),
    "rows of two antennas": (
        {"gnss.csv": [changed_cell(1, "exposure", to("e2"))]},
        ("e1 is 159 m farther off than most", "e1 and e2 are exchanged"),
    ),
    "one antenna": (
        {"gnss.csv": [changed_cell(3, "x_m", lambda v: repr(float(v) + 100.0))]},
        ("e3 is 100 m farther off than most",),
    ),
}


@pytest.mark.parametrize("mistake", EXPLAINED)
def test_an_absurd_block_ends_with_status_1_and_names_the_mistake(
    mistake, written, tmp_path
) -> None:
    changes, sentences = EXPLAINED[mistake]
    folder = changed(written, tmp_path, changes)
    if mistake == "rows of two antennas":
        path = folder / "gnss.csv"
        lines = path.read_text().splitlines()
        lines[4] = lines[4].replace("e2,", "e1,", 1)
        path.write_text("\n".join(lines) + "\n")
    report = adjusted_report(folder)
    assert report["sigma0"] > 20.0
    cautions = "\n".join(report["cautions"])
    for sentence in sentences:
        assert sentence in cautions


@pytest.mark.parametrize(("factor", "unit"), [(0.1, "centimetres"), (1.0 / 25.4, "inches")])
def test_image_coordinates_of_another_unit_of_length_are_named(
    factor, unit, written, tmp_path
) -> None:
    scaled = [changed_cell(-1, c, lambda v: repr(float(v) * factor)) for c in ("x_mm", "y_mm")]
    folder = changed(written, tmp_path, {"image_points.csv": scaled})
    outcome = CliRunner().invoke(app, ["adjust", str(folder)])
    assert outcome.exit_code == 1
    assert f"the image coordinates may be in {unit}" in outcome.output


def test_heights_of_another_system_are_not_taken_for_a_principal_distance(
    written, tmp_path
) -> None:
    off = [changed_cell(-1, "z_m", lambda v: repr(float(v) + 47.0))]
    cautions = adjusted_report(changed(written, tmp_path, {"gnss.csv": off}))["cautions"]
    assert any("are they ellipsoidal heights" in sentence for sentence in cautions)
    assert not any("principal distance" in sentence for sentence in cautions)
    assert np.isfinite(adjusted_report(written)["sigma0"])
