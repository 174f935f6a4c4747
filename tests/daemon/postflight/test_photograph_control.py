"""Control of photographs is weighted by its own accuracy and read as it was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.triangulation.control_mistakes import contradiction_m
from daemon.postflight.triangulation.displayed_pixels import as_stored, stored_px
from daemon.postflight.triangulation.ground_control import (
    image_index,
    no_control,
    read_gcp_list,
)
from daemon.postflight.triangulation.held_interior import free_principal_point
from daemon.postflight.triangulation.photograph_cautions import photograph_cautions
from daemon.postflight.triangulation.photograph_project import (
    adjusted_photographs,
    photograph_project,
    photographs_section,
    residual_sigma_px,
)
from daemon.postflight.triangulation.triangulation import TriangulationError
from processing.bundle.adjust import adjust
from processing.bundle.initial_values import completed
from tests.daemon.postflight.photograph_scene import F_PX, SIZE, measured_control, scene, turned

POSITIONS_M = (3.0, 3.0, 5.0)


def test_control_keeps_its_accuracy_where_features_match_many_times_better() -> None:
    """Tie points to 0.04 px, control to 0.4 px: all of it is used, and stations err as stated."""
    found, station, rotation = scene(tie_sigma_px=0.04)
    control = measured_control(station, rotation, sigma_px=0.4)
    project, result, less = adjusted_photographs(
        found, control, position_sigma_m=POSITIONS_M, reject_beyond=4.0
    )
    section = photographs_section(found, control, result)
    assert less == () and section["control_measurements_rejected"] == []
    ties, px = len(found.tied.image), project.network.image_points.sigma_mm / 0.01
    assert px[:ties].mean(axis=0) == pytest.approx([0.04, 0.04], rel=0.15)
    assert (px[ties:] == 0.5).all()
    columns = result.layout.station
    sigma = result.sigma0 * np.sqrt(np.diag(result.cofactor))[columns]
    assert np.abs((result.state.station - station) / sigma).max() < 4.0
    assert sigma.max() < 1.0


@pytest.mark.parametrize("share", [0.85, 1.0, 1.2])
def test_f_is_found_where_exif_is_wrong_by_a_fifth(share) -> None:
    """Also the principal point, 12 columns and -9 rows from the middle."""
    off = np.array([12.0, -9.0])
    found, station, rotation = scene(stated_f_px=share * F_PX)
    found = replace(found, tied=replace(found.tied, px=found.tied.px + off))
    control = measured_control(station, rotation)
    control = replace(control, px=control.px + off)
    _, result, _ = adjusted_photographs(
        found, control, position_sigma_m=POSITIONS_M, reject_beyond=4.0
    )
    (free,) = free_principal_point(result, longer_side_px=[SIZE[0]]) or ()
    section = photographs_section(found, control, result, [free])
    assert section["f_exif_px"] == pytest.approx(share * F_PX, rel=1e-6)
    assert section["f_px"] == pytest.approx(F_PX, abs=3.0 * section["f_sigma_px"])
    assert section["f_sigma_px"] < 6.0
    assert free.point_px == pytest.approx(tuple(off), abs=4.0 * max(free.point_sigma_px))
    if share != 1.0:
        assert any("f was adjusted by" in one for one in photograph_cautions(section))


def test_residuals_of_columns_and_rows_have_a_standard_deviation_each() -> None:
    found, _, _ = scene()
    px = found.tied.px + np.random.default_rng(1).normal(0.0, (0.4, 0.0), found.tied.px.shape)
    noisy = replace(found, tied=replace(found.tied, px=px))
    x, y = residual_sigma_px(noisy, POSITIONS_M)
    assert x == pytest.approx(0.41, rel=0.15) and y == pytest.approx(0.1, rel=0.3)


@pytest.mark.parametrize(
    ("source", "words"),
    [("", ""), ("none", "taken at 0 m"), ("RelativeAltitude", "above the takeoff point")],
)
def test_heights_of_another_reference_are_a_caution_without_control(source, words) -> None:
    found, station, rotation = scene()
    found = replace(found, height_source=source)
    for control in (no_control(), measured_control(station, rotation)):
        project = photograph_project(
            found, control, position_sigma_m=POSITIONS_M, reject_beyond=4.0
        )
        result = adjust(completed(project.network), project.settings)
        cautions = photograph_cautions(photographs_section(found, control, result))
        named = [one for one in cautions if words and words in one]
        assert len(named) == (1 if words and not control.names else 0)


def displayed(orientation: int, column: float, row: float) -> tuple[float, float]:
    """Where a viewer shows a pixel, by turning the indices of an image as the standard states."""
    width, height = SIZE
    rows, columns = np.mgrid[:height, :width].astype(float)
    image = np.dstack([columns, rows])
    turn = {
        1: image,
        2: image[:, ::-1],
        3: image[::-1, ::-1],
        4: image[::-1],
        5: image.transpose(1, 0, 2),
        6: image[::-1].transpose(1, 0, 2),
        7: image[::-1, ::-1].transpose(1, 0, 2),
        8: image[:, ::-1].transpose(1, 0, 2),
    }[orientation]
    r, c = np.argwhere((turn == [column, row]).all(axis=2))[0]
    return float(c), float(r)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_displayed_pixels_become_those_of_the_file(orientation) -> None:
    for column, row in ((0.0, 0.0), (37.0, 251.0), (399.0, 299.0)):
        shown = np.array([displayed(orientation, column, row)])
        assert stored_px(orientation, shown, SIZE).tolist() == [[column, row]]


@pytest.mark.parametrize("orientation", [(6, 8, 1), (3,), (2,)])
def test_control_measured_in_displayed_photographs_is_converted(orientation) -> None:
    found, station, rotation = scene()
    of = [orientation[k % len(orientation)] for k in range(8)]
    control = measured_control(station, rotation, sigma_px=0.0)
    whole = np.rint(control.px)
    px = [displayed(of[k], *at) for k, at in zip(control.image, whole, strict=True)]
    converted, (sentence,) = as_stored(turned(found, of), replace(control, px=np.array(px)))
    assert (converted.px == whole).all()
    assert f"{sum(one > 1 for one in of)} photographs with an Orientation" in sentence


def test_control_measured_in_stored_photographs_stays() -> None:
    found, station, rotation = scene()
    control = measured_control(station, rotation)
    for orientation in (3, 6, 8):
        assert as_stored(turned(found, [orientation] * 8), control) == (control, ())
    assert as_stored(found, control) == (control, ())
    assert contradiction_m(found, control) < 3.0


@pytest.mark.parametrize(
    "written", ["Foto 1 \u00fc.jpg", "Foto 1 u\u0308.jpg", "images/foto 1 \u00fc.JPG"]
)
@pytest.mark.parametrize("form", ["{} {} {} 10 20 {} p1", "{}\t{}\t{}\t10\t20\t{}\tp1"])
def test_names_of_photographs_may_have_spaces_and_accents(tmp_path, written, form) -> None:
    """As cameras, macOS (decomposed) and people write them."""
    path = tmp_path / "gcp_list.txt"
    place = ("682000.0", "5213000.0", "600.0")
    path.write_text("EPSG:32632\n" + form.format(*place, written) + "\n", encoding="utf-8")
    images = image_index(["000001_C"], {"000001_C": "Foto 1 \u00fc.jpg"})
    found = read_gcp_list(path, images, LocalFrame(47.05, 11.4))
    assert found.names == ("p1",) and found.image.tolist() == [0] and found.unused == ()
    assert found.px.tolist() == [[10.0, 20.0]]


@pytest.mark.parametrize(
    "line",
    [
        "682000,5;5213000,25;600,5;10,5;20;img_1.jpg;p1",
        "682000.5;5213000.25;600.5;10.5;20;IMG_1.JPG;p1",
    ],
)
def test_cells_of_a_spreadsheet_are_read(tmp_path, line) -> None:
    path = tmp_path / "gcp_list.txt"
    frame = LocalFrame(47.05, 11.4)
    path.write_text("EPSG:32632\n682000.5 5213000.25 600.5 10.5 20 img_1.jpg p1\n")
    expected = read_gcp_list(path, {"img_1.jpg": 0}, frame)
    path.write_text(f"EPSG:32632\n{line}\n")
    found = read_gcp_list(path, {"img_1.jpg": 0}, frame)
    assert (found.xyz_m == expected.xyz_m).all() and found.px.tolist() == [[10.5, 20.0]]


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("682000,5 5213000,25 600,5 10 20 img_1.jpg p1", "'5'"),
        ("682000.5 5213000.25 600.5 10 20 img_9.jpg p1", "'img_9.jpg'"),
    ],
)
def test_control_of_other_photographs_only_is_refused(tmp_path, line, named) -> None:
    """Such as decimal commas between spaces, which make other columns."""
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"EPSG:32632\n{line}\n")
    with pytest.raises(TriangulationError, match=f"the first one names {named}.*decimal points"):
        read_gcp_list(path, {"img_1.jpg": 0}, LocalFrame(47.05, 11.4))
