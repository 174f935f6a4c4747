"""A measurement far outside the image of its camera is named with its file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.adjustment.project import read_project

SIZE = (6000, 4000)
PIXEL_MM = 0.005
HALF_MM = (15.0, 10.0)
"""Half of the format."""

FAR_MM = 0.1 * 30.0
"""Beyond the edge a measurement is far outside."""


def _project(
    folder: Path, rows: list[tuple[float, float]], *, camera: str = "", pixels: bool = False
) -> Path:
    """A project of one image with these measurements, written as a user does."""
    (folder / "project.toml").write_text(
        f'format = 1\nname = "x"\n[[camera]]\nname = "c"\nf_mm = 50.0\n{camera}'
        f"pixel_um = 5.0\nwidth_px = {SIZE[0]}\nheight_px = {SIZE[1]}\n"
    )
    (folder / "images.csv").write_text("image,camera\ni1,c\n")
    names = "column_px,row_px" if pixels else "x_mm,y_mm"
    lines = [f"i1,p{k},{x},{y}" for k, (x, y) in enumerate(rows)]
    (folder / "image_points.csv").write_text("\n".join([f"image,point,{names}", *lines]) + "\n")
    return folder / "project.toml"


def _spread(count: int = 30) -> list[tuple[float, float]]:
    random = np.random.default_rng(1)
    return [tuple(xy) for xy in random.uniform(-1.0, 1.0, (count, 2)) * HALF_MM]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_row_far_outside_is_named_and_one_at_the_edge_is_not(tmp_path, axis, sign) -> None:
    rows = _spread()
    edge = [0.0, 0.0]
    edge[axis] = sign * (HALF_MM[axis] + 0.99 * FAR_MM)
    rows[7] = (edge[0], edge[1])
    read_project(_project(tmp_path, rows))
    edge[axis] = sign * (HALF_MM[axis] + 1.01 * FAR_MM)
    rows[7] = (edge[0], edge[1])
    with pytest.raises(ProjectError) as error:
        read_project(_project(tmp_path, rows))
    (problem,) = error.value.problems
    assert problem.startswith("image_points.csv:9: image i1 measures point p7 at ")
    assert "far outside the format of camera c, 6000 x 4000 px of 5 um (30 x 20 mm)" in problem


def test_pixels_far_outside_are_named_too(tmp_path) -> None:
    rows = [((x / PIXEL_MM) + 2999.5, 1999.5 - y / PIXEL_MM) for x, y in _spread()]
    rows[3] = (12000.0, 300.0)
    with pytest.raises(ProjectError, match=r"image_points\.csv:5: image i1 measures point p3 at "):
        read_project(_project(tmp_path, rows, pixels=True))


def test_coordinates_from_a_corner_hold_about_the_principal_point_only(tmp_path) -> None:
    rows = [(x + HALF_MM[0], y - HALF_MM[1]) for x, y in _spread()]
    read_project(_project(tmp_path, rows, camera="xp_mm = 15.0\nyp_mm = -10.0\n"))
    with pytest.raises(ProjectError) as error:
        read_project(_project(tmp_path, rows))
    (problem,) = error.value.problems
    assert "of 30 image points, this one first, are far outside" in problem
    assert "count coordinates from the middle of the image" in problem
