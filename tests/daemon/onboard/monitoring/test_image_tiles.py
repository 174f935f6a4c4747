"""Tiles of an image at full resolution are its pixels, and only windows of the file are read."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from daemon.mission.store.level0 import tiff_parts
from daemon.onboard.monitoring.image_tiles import (
    FULL_SCALE,
    ImageTileError,
    ImageTiles,
    sharpness_of,
)

HEIGHT, WIDTH = 700, 1100


def write(path: Path, *planes: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(bytes(part) for part in tiff_parts(planes, {"bands": ["x"]})))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    random = np.random.default_rng(2)
    pan = random.integers(2000, 20000, (HEIGHT, WIDTH), dtype=np.uint16)
    pan = cv2.GaussianBlur(pan, (0, 0), 4.0)
    pan[300:340, 500:560] = FULL_SCALE
    pan[:, :20] = 0
    write(tmp_path / "pan.tif", pan)
    colour = cv2.resize(pan, (WIDTH // 3, HEIGHT // 3), interpolation=cv2.INTER_AREA)
    write(tmp_path / "rgbn.tif", colour, colour // 2, colour // 3, colour)
    return tmp_path


def picture(
    tiles: ImageTiles, folder: Path, layer: str, reduction: int, x: int, y: int
) -> np.ndarray:
    found = tiles.tile(folder, layer, reduction, x, y)
    assert found is not None
    return cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_UNCHANGED)


def shown(values: np.ndarray, tiles: ImageTiles, folder: Path) -> np.ndarray:
    raster = tiles._raster(folder / "pan.tif")
    return 255 * np.clip((values - raster.low) / (raster.high - raster.low), 0, 1) ** (1 / 2.2)


def test_layers_and_sizes_are_listed(folder: Path) -> None:
    about = ImageTiles().about(folder)
    assert [one["name"] for one in about["layers"]] == ["pan", "rgbn"]
    assert (about["layers"][0]["width_px"], about["layers"][1]["width_px"]) == (WIDTH, WIDTH // 3)
    assert about["reductions"] == [1, 2, 4, 8, 16]


@pytest.mark.parametrize("reduction", [1, 2, 4])
def test_a_tile_holds_the_pixels_of_its_place(folder: Path, reduction: int) -> None:
    tiles, pan = ImageTiles(), tifffile.imread(folder / "pan.tif").astype(float)
    found = picture(tiles, folder, "pan", reduction, 1 if reduction < 4 else 0, 0)
    left = (256 if reduction < 4 else 0) * reduction
    rows = min(256, HEIGHT // reduction)
    window = pan[: rows * reduction, left : left + 256 * reduction]
    columns = window.shape[1] // reduction
    window = window[:, : columns * reduction].reshape(rows, reduction, columns, reduction)
    expected = shown(window.mean(axis=(1, 3)), tiles, folder)
    image = (found if found.ndim == 2 else found[..., 0]).astype(float)[:rows, :columns]
    inside = np.s_[8:-8, 40:-8]
    assert np.abs(image[inside] - expected[inside]).mean() < 3.0


def test_colour_lies_on_the_panchromatic_image(folder: Path) -> None:
    tiles = ImageTiles()
    pan = picture(tiles, folder, "pan", 1, 1, 1)
    colour = picture(tiles, folder, "rgbn", 1, 1, 1)
    assert colour.shape[2] in (3, 4)
    red = colour[..., 2].astype(np.float32)
    grey = (pan if pan.ndim == 2 else pan[..., 0]).astype(np.float32)
    (shift_x, shift_y), _ = cv2.phaseCorrelate(
        cv2.GaussianBlur(grey, (0, 0), 3), cv2.GaussianBlur(red, (0, 0), 3)
    )
    assert abs(shift_x) < 0.5
    assert abs(shift_y) < 0.5


def test_no_data_is_transparent_and_saturation_is_marked(folder: Path) -> None:
    tiles = ImageTiles()
    assert (picture(tiles, folder, "pan", 1, 0, 0)[:, :20, 3] == 0).all()
    marked = picture(tiles, folder, "saturation", 1, 2, 1)[..., 3]
    assert (marked[44:84, 0:48] == 254).all(), "rows 300 to 340, columns 512 to 560"
    assert marked.sum() == 40 * 48 * 254
    reduced = picture(tiles, folder, "saturation", 4, 0, 0)[..., 3]
    assert (reduced[75:85, 125:140] == 254).all()


def test_sharpness_separates_a_blurred_image_from_a_sharp_one() -> None:
    random = np.random.default_rng(3)
    sharp = random.integers(2000, 20000, (32, 128), dtype=np.uint16)
    blurred = cv2.GaussianBlur(sharp, (0, 0), 3.0)
    flat = np.full((32, 32), 5000, np.uint16)
    assert (sharpness_of(sharp) > 0.9).all()
    assert (sharpness_of(blurred) < 0.56).all()
    assert np.isnan(sharpness_of(flat)).all()


def test_beyond_the_image_there_is_no_tile(folder: Path) -> None:
    tiles = ImageTiles()
    assert tiles.tile(folder, "pan", 1, 5, 0) is None
    assert tiles.tile(folder, "pan", 16, 0, 1) is None
    assert tiles.tile(folder, "sharpness", 8, 0, 0) is not None
    for layer, reduction in (("nir", 1), ("pan", 3), ("../pan", 1)):
        with pytest.raises(ImageTileError):
            tiles.tile(folder, layer, reduction, 0, 0)


@pytest.mark.trust
def test_a_damaged_image_is_reported(tmp_path: Path, folder: Path) -> None:
    tiles = ImageTiles()
    whole = (folder / "pan.tif").read_bytes()
    for content in (b"", b"II*\0", whole[:5000], whole[: len(whole) // 2], b"\xff\xd8" + whole):
        broken = tmp_path / "broken"
        broken.mkdir(exist_ok=True)
        (broken / "pan.tif").write_bytes(content)
        with pytest.raises(ImageTileError, match=r"pan\.tif"):
            tiles.tile(broken, "pan", 1, 0, 0)
    tifffile.imwrite(broken / "pan.tif", np.zeros((64, 64), np.uint16), compression="zlib")
    with pytest.raises(ImageTileError, match="no uncompressed image"):
        tiles.tile(broken, "pan", 1, 0, 0)
    with pytest.raises(ImageTileError, match="no image of full resolution"):
        tiles.about(tmp_path / "nothing")


def test_memory_is_that_of_a_tile_and_not_of_the_image(tmp_path: Path) -> None:
    """A sparse file of the size of a full image: 14430 x 9420 pixels, 272 MB."""
    write(tmp_path / "pan.tif", np.full((64, 64), 9000, np.uint16))
    import struct

    header = bytearray((tmp_path / "pan.tif").read_bytes()[: -64 * 64 * 2])
    tags = struct.unpack_from("<I", header, 4)[0]
    width, height = 14430, 9420
    for index in range(struct.unpack_from("<H", header, tags)[0]):
        at = tags + 2 + 12 * index
        tag, kind = struct.unpack_from("<HH", header, at)
        value = {256: width, 257: height, 278: height, 279: width * height * 2}.get(tag)
        if value is not None:
            struct.pack_into("<HHI", header, at, tag, 4 if value > 65535 else kind, 1)
            struct.pack_into("<I" if value > 65535 or kind == 4 else "<H", header, at + 8, value)
    with (tmp_path / "pan.tif").open("wb") as file:
        file.write(header)
        file.truncate(len(header) + width * height * 2)
    tiles = ImageTiles()
    assert tiles.about(tmp_path)["layers"][0]["width_px"] == width
    tracemalloc.start()
    for layer in ("pan", "saturation", "sharpness"):
        tiles.tile(tmp_path, layer, 16, 1, 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 25_000_000


@pytest.mark.parametrize("reduction", [4, 8, 16])
def test_colour_fills_the_tile_at_each_reduction(tmp_path: Path, reduction: int) -> None:
    side = 256 * reduction
    write(tmp_path / "pan.tif", np.full((side, side), 9000, np.uint16))
    grey = np.full((side // 3 + 1, side // 3 + 1), 9000, np.uint16)
    write(tmp_path / "rgbn.tif", grey, grey, grey, grey)
    colour = picture(ImageTiles(), tmp_path, "rgbn", reduction, 0, 0)
    assert colour.shape[:2] == (256, 256)
    # Where there is no data the tile is transparent; without transparency it is complete.
    assert colour.shape[2] == 3 or colour[:254, :254, 3].min() == 255


def test_saturation_and_sharpness_are_those_of_the_layer_that_is_shown(tmp_path: Path) -> None:
    random, tiles = np.random.default_rng(3), ImageTiles()
    first = random.integers(2000, 20000, (512, 512), dtype=np.uint16)
    second = cv2.GaussianBlur(first, (0, 0), 4.0)
    first[64:128, 64:128] = FULL_SCALE
    second[320:384, 64:128] = FULL_SCALE
    third = cv2.resize(second, (128, 128), interpolation=cv2.INTER_NEAREST)
    for name, plane in (("aft", first), ("fore", second), ("thermal", third)):
        write(tmp_path / f"{name}.tif", plane)

    def overlay(layer: str, of: str | None) -> np.ndarray:
        found = tiles.tile(tmp_path, layer, 2, 0, 0, of)
        assert found is not None
        return cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_UNCHANGED)

    for of, row in ((None, 48), ("aft", 48), ("fore", 176), ("thermal", 176)):
        alpha = overlay("saturation", of)[..., 3]
        assert alpha[row, 48] == 254, of
        assert alpha[224 - row, 48] == 0, of
    # Blue, green, red: the first one is sharp and green, the second one is blurred and red.
    sharp, blurred = overlay("sharpness", "aft")[8, 200], overlay("sharpness", "fore")[8, 200]
    assert sharp[1] > sharp[2]
    assert blurred[2] > blurred[1]
    with pytest.raises(ImageTileError, match="no layer 'side'"):
        tiles.tile(tmp_path, "sharpness", 2, 0, 0, "side")
