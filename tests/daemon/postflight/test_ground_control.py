"""Coordinate systems of `gcp_list.txt`: accurate, or refused with what is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.triangulation.ground_control import read_gcp_list
from daemon.postflight.triangulation.triangulation import TriangulationError

FRAME = LocalFrame(51.5, 0.0)


def _read(folder: Path, system: str, place: str = "538000 180000 100.0") -> np.ndarray:
    path = folder / "gcp_list.txt"
    path.write_text(f"{system}\n{place} 10 20 a.jpg p\n")
    return read_gcp_list(path, {"a.jpg": 0}, FRAME).xyz_m[0]


@pytest.mark.parametrize("system", ["EPSG:25831+7837", "EPSG:32631+3855", "EPSG:32631+5773"])
def test_heights_above_a_geoid_without_its_grid_are_refused(tmp_path: Path, system: str) -> None:
    with pytest.raises(TriangulationError, match="line 1"):
        _read(tmp_path, system, "291000 5709000 100.0")


def test_without_a_height_system_heights_are_above_the_ellipsoid_of_wgs_84(tmp_path: Path) -> None:
    utm = _read(tmp_path, "EPSG:32631", "291783.128 5709696.984 100.0")
    geographic = _read(tmp_path, "EPSG:4326", "0.0 51.5 100.0")
    assert utm == pytest.approx(geographic, abs=2e-3)


def test_feet_without_a_height_system_are_refused_with_the_cure(tmp_path: Path) -> None:
    with pytest.raises(TriangulationError, match=r"US survey foot.*add a height system"):
        _read(tmp_path, "EPSG:2236", "900000 600000 100.0")


@pytest.mark.parametrize("system", ["EPSG:4978", "EPSG:5773", "nonsense"])
def test_what_is_neither_projected_nor_geographic_is_refused(tmp_path: Path, system: str) -> None:
    with pytest.raises(TriangulationError, match="line 1"):
        _read(tmp_path, system)


ROW = "538000 180000 100.0 10 20 a.jpg P\n"


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (
            ROW + ROW.replace("10 20", "13 24"),
            r"point P is measured twice in a\.jpg, 5\.0 px apart",
        ),
        (ROW.replace("10 20", "1_0 20"), "line 2: east north height column row image"),
        (ROW.replace("10 20", "\u0663 20"), "line 2: east north height column row image"),
    ],
)
def test_rows_that_contradict_or_are_no_numbers_are_refused(tmp_path, rows, sentence) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"EPSG:32631\n{rows}", encoding="utf-8")
    with pytest.raises(TriangulationError, match=sentence):
        read_gcp_list(path, {"a.jpg": 0}, FRAME)


def test_a_row_that_was_copied_counts_once(tmp_path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"EPSG:32631\n{ROW}{ROW}{ROW.replace('a.jpg', 'b.jpg')}")
    found = read_gcp_list(path, {"a.jpg": 0, "b.jpg": 1}, FRAME)
    assert found.names == ("P",) and found.px.tolist() == [[10.0, 20.0]] * 2
