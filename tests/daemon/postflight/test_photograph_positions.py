"""Positions that no block has, and TIFF files that end early."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest
import tifffile

from daemon.postflight.importers.multispectral_tags import ImagesError
from daemon.postflight.importers.photograph_positions import implausible_positions, same_place
from daemon.postflight.importers.photographs import import_photographs
from tests.daemon.postflight.test_photograph_files import pixels, settings_of, write_jpeg


def folder_at(tmp_path: Path, *places: tuple[float, float, float]) -> Path:
    for k, place in enumerate(places):
        write_jpeg(tmp_path / f"in/P{k}.jpg", place=(*place[:2], 700.0), seed=k)
        if place[2] != 700.0:
            path = tmp_path / f"in/P{k}.jpg"
            height = struct.pack("<II", 700_000_000, 1_000_000)
            data = path.read_bytes()
            assert data.count(height) == 1
            path.write_bytes(data.replace(height, struct.pack("<II", round(place[2]), 1)))
    return tmp_path / "in"


NEAR = [(47.0 + k * 1e-4, 11.0, 700.0) for k in range(3)]


@pytest.mark.parametrize(
    ("place", "sentence"),
    [
        ((57.0, 11.0, 700.0), r"P3\.jpg: its position in EXIF is 1\d\d\d km from the middle"),
        ((47.0, 11.0, 1e6), r"P3\.jpg: its height in EXIF is 1e\+06 m; -500 to 20000 m"),
    ],
)
def test_one_position_that_cannot_be_is_named_and_not_used(tmp_path, place, sentence) -> None:
    folder = folder_at(tmp_path, *NEAR, place)
    done = import_photographs(folder, tmp_path / "out")
    assert [one.position is None for one in done.photographs] == [False, False, False, True]
    (note,) = [note for note in done.notes if note.startswith("P3.jpg")]
    assert note.endswith("It is not used.")
    assert re.match(sentence, note)
    assert "GpsLatitudeDeg" not in settings_of(tmp_path / "out", 4)


@pytest.mark.parametrize(
    ("places", "sentence"),
    [
        ([(47.0 + 10 * k, 11.0, 700.0) for k in range(4)], r"P0\.jpg: .* km from the middle"),
        ([(*place[:2], 1e6) for place in NEAR], r"0 of 3 .*P0\.jpg: its height in EXIF is 1e\+06"),
    ],
)
def test_positions_of_no_block_are_refused(tmp_path, places, sentence) -> None:
    folder = folder_at(tmp_path, *places)
    with pytest.raises(ImagesError, match=sentence):
        import_photographs(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_same_place_of_all_photographs_is_a_caution(tmp_path) -> None:
    folder = folder_at(tmp_path, *[NEAR[0]] * 3)
    notes = import_photographs(folder, tmp_path / "out").notes
    assert any(note.startswith("All 3 positions of EXIF are the same, 47.0") for note in notes)
    write_jpeg(folder / "P3.jpg", place=NEAR[1], seed=3)
    notes = import_photographs(folder, tmp_path / "other").notes
    assert not any("are the same" in note for note in notes)


def test_heights_of_no_aircraft_are_named() -> None:
    places = [(47.0, 11.0, height) for height in (-400.0, -600.0, 19_000.0, 21_000.0)]
    assert list(implausible_positions(places)) == [1, 3]


def test_a_climb_or_a_date_line_is_a_block() -> None:
    assert same_place([(47.0, 11.0, 700.0), (47.0, 11.0, 730.0)]) == ""
    assert same_place([(47.0, 11.0, float("nan")), (47.0, 11.0, float("nan"))]) != ""
    assert implausible_positions([(0.0, 179.999, 5.0), (0.0, -179.999, 5.0), None]) == {}


@pytest.mark.parametrize("tile", [None, (16, 16)])
def test_a_tiff_that_ends_early_is_refused_by_name(tmp_path, tile) -> None:
    """Its directory stands before its pixels: tags are complete where pixels are not."""
    folder, path = folder_at(tmp_path, *NEAR), tmp_path / "in/P9.tif"
    tifffile.imwrite(path, pixels(9), tile=tile, photometric="rgb")
    given = {"focal_mm": 4.0, "pixel_um": 10.0}
    assert len(import_photographs(folder, tmp_path / "good", **given).photographs) == 4
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    with pytest.raises(ImagesError, match=r"P9\.tif: ends before its image does \(\d+ of \d+ by"):
        import_photographs(folder, tmp_path / "out", **given)
