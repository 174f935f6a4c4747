"""Tables of measured points with mistakes: each is a sentence with file and line."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.triangulation.measured_points import (
    MeasuredPointsError,
    read_measured_points,
)

POINTS = "point,role,latitude_deg,longitude_deg,height_m\nA,control,48.1,11.5,500\n"
MEASURED = "image,point,column_px,row_px,sigma_px\n000007,A,100,200,0.3\n"


def _read(folder: Path, points: str, measured: str) -> int:
    (folder / "p.csv").write_text(points)
    (folder / "m.csv").write_text(measured)
    frame = LocalFrame(48.1, 11.5)
    found = read_measured_points(("000007",), frame, folder / "p.csv", folder / "m.csv")
    return len(found.px)


def test_tables_without_mistakes_are_read(tmp_path) -> None:
    assert _read(tmp_path, POINTS, MEASURED) == 1


@pytest.mark.parametrize(
    ("points", "measured", "sentence"),
    [
        (POINTS, MEASURED.splitlines()[0] + "\n", r"^m.csv:1: no rows"),
        (POINTS.splitlines()[0] + "\n", MEASURED, r"p.csv:1: no rows"),
        (POINTS, MEASURED + MEASURED.splitlines()[1] + "\n", r"^m.csv:3: image 000007 measures"),
        (POINTS, MEASURED.replace("0.3", "0"), r"^m.csv:2: sigma_px is 0; a sigma is positive"),
        (POINTS, MEASURED.replace("000007", "7"), r"^m.csv:2: image '7' is not there"),
    ],
)
def test_a_mistake_is_a_sentence_with_file_and_line(tmp_path, points, measured, sentence) -> None:
    with pytest.raises(MeasuredPointsError, match=sentence):
        _read(tmp_path, points, measured)
