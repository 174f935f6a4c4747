"""Lists of control points (gcp_list.txt) are read as several programs write them."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.triangulation.ground_control import (
    read_gcp_list,
)
from daemon.postflight.triangulation.triangulation import TriangulationError


def test_an_odm_list_of_control_points_is_read(tmp_path) -> None:
    frame = LocalFrame(41.0371, -83.3061)
    path = tmp_path / "gcp_list.txt"
    path.write_text(
        "WGS84 UTM 17N\n"
        "306200.5 4545500.25 210.0 100.5 200.25 IMG_1.jpg a\n"
        "306200.5 4545500.25 210.0 300 400 img_2.JPG a\n"
        "306250.0 4545500.25 211.0 10 20 IMG_1.jpg b\n"
        "306250.0 4545500.25 211.0 10 20 IMG_9.jpg b\n"
    )
    found = read_gcp_list(path, {"img_1.jpg": 0, "img_2.jpg": 1}, frame)
    assert found.names == ("a", "b") and found.image.tolist() == [0, 1, 0]
    assert found.px[0].tolist() == [100.5, 200.25]
    away = found.xyz_m[1] - found.xyz_m[0]
    assert np.hypot(*away[:2]) == pytest.approx(49.5, abs=0.03) and away[2] == pytest.approx(
        1, abs=0.01
    )
    assert found.unused == ("IMG_9.jpg: b",)
    path.write_text("WGS84 UTM 99N\n1 2 3 4 5 IMG_1.jpg\n")
    with pytest.raises(TriangulationError, match="no coordinate system"):
        read_gcp_list(path, {"img_1.jpg": 0}, frame)
    path.write_text("EPSG:32617\n1 2 3 4 IMG_1.jpg\n")
    with pytest.raises(TriangulationError, match="line 2"):
        read_gcp_list(path, {"img_1.jpg": 0}, frame)


@pytest.mark.parametrize(
    ("header", "lines"),
    [
        ("EPSG:32617", ["{} images/IMG_1.JPG", "{} ./IMG_2.jpg"]),
        ("WGS84 UTM 17N", ["{} IMG_1.tif gcp more columns", "{} img_2 gcp"]),
        ("+proj=utm +zone=17 +ellps=WGS84 +units=m", ["{} IMG_1.JPG", "{}\tIMG_2.JPG"]),
        ("32617", ["{},IMG_1.JPG", "{} IMG_2.JPG"]),
    ],
    ids=["folders", "other suffix", "no datum", "commas"],
)
def test_gcp_lists_as_programs_write_them_are_read_alike(tmp_path, header, lines) -> None:
    """Points without a name are one if their coordinates are, however they are written."""
    path = tmp_path / "gcp_list.txt"
    place = ("306162.164 4545392.858 220.0 10 20", "306162.164 4545392.858 220 10 20")
    rows = [line.format(own) for line, own in zip(lines, place, strict=True)]
    path.write_text("\n".join([header, *rows]))
    frame = LocalFrame(41.0367, -83.306)
    found = read_gcp_list(path, {"img_1.jpg": 0, "img_2.jpg": 1}, frame)
    assert len(found.names) == 1 and found.image.tolist() == [0, 1] and not found.unused
    assert found.xyz_m[0] == pytest.approx([0.0, 0.0, 220.0], abs=0.1)
