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
