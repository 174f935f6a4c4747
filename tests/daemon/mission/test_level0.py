"""The TIFF we write, read by others; TIFFs of others, read by us."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from daemon.mission.store.level0 import (
    PIXEL_ALIGNMENT,
    RasterError,
    read_description,
    read_tiff,
    read_tiff_rows,
    tiff_parts,
)

PIXELS = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)


def _write(path, planes, description=None):
    path.write_bytes(b"".join(tiff_parts(planes, description or {})))
    return path


def test_another_program_reads_the_pixels_and_the_tags(tmp_path):
    path = _write(tmp_path / "SU00.tif", [PIXELS], {"sensor": "SU00", "note": "Grüße"})
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        assert np.array_equal(page.asarray(), PIXELS)
        assert (page.compression, page.bitspersample, page.rowsperstrip) == (1, 16, 48)
        assert page.is_contiguous
        assert page.dataoffsets == (PIXEL_ALIGNMENT,)
    assert read_description(path) == {"sensor": "SU00", "note": "Grüße"}
    assert path.stat().st_size == PIXEL_ALIGNMENT + PIXELS.nbytes


def test_the_pixels_are_one_block_that_can_be_mapped(tmp_path):
    path = _write(tmp_path / "a.tif", [PIXELS])
    mapped = np.memmap(path, "<u2", "r", offset=PIXEL_ALIGNMENT, shape=PIXELS.shape)
    assert np.array_equal(mapped, PIXELS)


def test_four_bands_are_four_planes_in_their_order(tmp_path):
    planes = [PIXELS + band for band in range(4)]
    path = _write(tmp_path / "rgbn.tif", planes)
    with tifffile.TiffFile(path) as tiff:
        assert tiff.pages[0].photometric == tifffile.PHOTOMETRIC.RGB
        assert tiff.pages[0].planarconfig == tifffile.PLANARCONFIG.SEPARATE
        assert np.array_equal(tiff.pages[0].asarray(), np.stack(planes))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_any_number_of_bands_is_read_back(tmp_path, count):
    planes = [PIXELS + band for band in range(count)]
    stack = tifffile.imread(_write(tmp_path / "x.tif", planes))
    assert np.array_equal(stack.reshape(count, 48, 64), np.stack(planes))


def test_opencv_reads_it(tmp_path):
    import cv2

    path = _write(tmp_path / "a.tif", [PIXELS])
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), PIXELS)


def test_no_pixel_is_copied_on_the_way():
    header, pixels = tiff_parts([PIXELS], {})
    assert np.shares_memory(np.frombuffer(pixels, np.uint16), PIXELS)
    assert len(header) == PIXEL_ALIGNMENT


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"bigtiff": True}])
def test_a_tiff_of_another_writer_is_accepted(tmp_path, options):
    tifffile.imwrite(tmp_path / "b.tif", PIXELS, **options)
    assert np.array_equal(read_tiff(tmp_path / "b.tif", width_px=64, height_px=48), PIXELS)
    assert read_description(tmp_path / "b.tif").get("sensor") is None


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (PIXELS.astype(np.uint8), "holds uint8"),
        (PIXELS[:, :32], "32 x 48 px; the sensor has 64 x 48 px"),
        (np.stack([PIXELS] * 3, axis=-1), "one plane"),
    ],
)
def test_a_tiff_that_does_not_fit_is_refused_with_what_was_found(tmp_path, pixels, expected):
    tifffile.imwrite(tmp_path / "c.tif", np.ascontiguousarray(pixels))
    with pytest.raises(RasterError, match=expected):
        read_tiff(tmp_path / "c.tif", width_px=64, height_px=48)


@pytest.mark.parametrize("plane", [2, 3])
def test_a_plane_that_the_file_does_not_have_is_refused(tmp_path, plane):
    path = _write(tmp_path / "two.tif", [PIXELS, PIXELS])
    assert np.array_equal(read_tiff(path, plane=1), PIXELS)
    with pytest.raises(RasterError, match="one plane"):
        read_tiff(path, plane=plane)


def test_a_torn_or_foreign_file_is_refused_at_every_length(tmp_path):
    intact = b"".join(tiff_parts([PIXELS], {"sensor": "SU00"}))
    for length in [*range(0, 400, 7), PIXEL_ALIGNMENT, len(intact) - 1]:
        (tmp_path / "d.tif").write_bytes(intact[:length])
        with pytest.raises(RasterError):
            read_tiff(tmp_path / "d.tif")


@pytest.mark.parametrize(
    "planes",
    [[], [PIXELS.astype(np.int16)], [PIXELS[:, ::2]], [PIXELS, PIXELS[1:]], [PIXELS[:0]]],
)
def test_arrays_that_are_no_frame_are_refused(planes):
    with pytest.raises(RasterError):
        tiff_parts(planes, {})


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"byteorder": ">"}])
def test_rows_of_planes_are_those_of_the_whole_raster(tmp_path, options):
    planes = np.stack([PIXELS + band for band in range(3)])
    if options:
        tifffile.imwrite(
            tmp_path / "x.tif", planes, planarconfig="separate", photometric="rgb", **options
        )
    else:
        _write(tmp_path / "x.tif", list(planes))
    size = {"width_px": 64, "height_px": 48}
    found = read_tiff_rows(tmp_path / "x.tif", 5, 7, planes=[2, 0], **size)
    assert np.array_equal(found, planes[[2, 0], 5:12]) and found.dtype == np.uint16
    with pytest.raises(RasterError):
        read_tiff_rows(tmp_path / "x.tif", 5, 7, planes=[3], **size)


def test_only_the_bytes_of_the_rows_are_read(tmp_path, monkeypatch):
    path = _write(tmp_path / "large.tif", [np.zeros((3000, 3000), np.uint16)])
    counts = []
    real = tifffile.FileHandle.read
    monkeypatch.setattr(
        tifffile.FileHandle, "read", lambda self, n=-1: counts.append(n) or real(self, n)
    )
    rows = read_tiff_rows(path, 2990, 10, width_px=3000, height_px=3000)
    assert rows.shape == (10, 3000) and -1 not in counts and sum(counts) < 3 * 10 * 3000 * 2
