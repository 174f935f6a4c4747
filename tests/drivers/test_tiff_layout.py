"""Tags that change what the words of a TIFF mean are refused with a cure, never ignored."""

import io

import numpy as np
import pytest
import tifffile

from daemon.mission.store.level0 import RasterError, check_tiff, read_frame, read_tiff
from drivers.cameras.folder.frames import FrameFileError
from drivers.cameras.folder.frames import read_frame as read_folder_frame
from drivers.cameras.tiff_layout import MAX_PAGES, layout_problem

pytestmark = pytest.mark.trust
PIXELS = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)


def written(path, *, photometric="minisblack", pages=1, subfiletype=0, **options):
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(PIXELS, photometric=photometric, contiguous=False, **options)
        for _ in range(pages - 1):
            tiff.write(PIXELS[::2, ::2], subfiletype=subfiletype, contiguous=False)
    return path


def orientation(value):
    return {"extratags": [(274, 3, 1, value, True)]}


REFUSED = [
    *(
        pytest.param(orientation(n), f"Orientation is {n};", id=f"orientation {n}")
        for n in (2, 3, 8)
    ),
    pytest.param({"photometric": "miniswhite"}, "MinIsWhite", id="min is white"),
    pytest.param({"pages": 2}, "several images .page 2", id="two pages"),
    pytest.param(
        {"pages": MAX_PAGES + 2, "subfiletype": 1}, "more than 16 pages", id="endless overviews"
    ),
]


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_a_tag_that_changes_the_meaning_is_refused(tmp_path, options, message):
    path = written(tmp_path / "SU30.tif", **options)
    for read in (
        lambda: read_frame(path, width_px=64, height_px=48),
        lambda: read_tiff(path),
        lambda: check_tiff(path, width_px=64, height_px=48),
    ):
        with pytest.raises(RasterError, match=f"SU30.tif: .*{message}"):
            read()
    with pytest.raises(FrameFileError, match=message):
        read_folder_frame(path, max_nbytes=1 << 20)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="plain"),
        pytest.param(orientation(1), id="orientation 1"),
        pytest.param(
            {"photometric": "cfa", "extratags": [(33421, 3, 2, (2, 2), True)]}, id="bayer"
        ),
        pytest.param({"pages": 3, "subfiletype": 1}, id="overviews"),
    ],
)
def test_a_frame_of_usual_tags_is_read(tmp_path, options):
    path = written(tmp_path / "SU30.tif", **options)
    assert np.array_equal(read_frame(path, width_px=64, height_px=48).pixels, PIXELS)
    assert np.array_equal(read_folder_frame(path, max_nbytes=1 << 20).pixels, PIXELS)


def test_exactly_as_many_overviews_as_allowed_are_read():
    file = io.BytesIO()
    with tifffile.TiffWriter(file) as tiff:
        tiff.write(PIXELS, contiguous=False)
        for _ in range(MAX_PAGES - 1):
            tiff.write(PIXELS[::8, ::8], subfiletype=1, contiguous=False)
    file.seek(0)
    with tifffile.TiffFile(file) as tiff:
        assert len(tiff.pages) == MAX_PAGES
        assert layout_problem(tiff) is None
