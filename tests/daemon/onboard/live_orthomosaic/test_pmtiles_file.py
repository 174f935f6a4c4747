"""Written PMTiles files, read by the reader of base maps."""

from __future__ import annotations

import pytest

from daemon.onboard.live_orthomosaic.pmtiles_file import write_pmtiles
from daemon.onboard.monitoring.maps.pmtiles import PmtilesMap

BOUNDS = (14.0, 47.0, 15.0, 48.0)


def test_a_file_with_leaf_directories_gives_back_every_tile(tmp_path) -> None:
    tiles = {}
    for k in range(12_000):
        path = tmp_path / "t" / f"{k % 97}"
        if k < 97:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"RIFF0000WEBP" + bytes([k]) * (k * 37 % 251))
        tiles[16, (k * 7919) % 65_536, k % 3000] = path
    write_pmtiles(tmp_path / "map.pmtiles", tiles, BOUNDS, {"name": "all"})
    found = PmtilesMap(tmp_path / "map.pmtiles")
    try:
        assert found._root.run_lengths[0] == 0  # a leaf directory
        for tile, path in list(tiles.items())[::97]:
            assert found.tile(*tile).data == path.read_bytes()
        assert found.description.bounds == BOUNDS and found.description.name == "all"
    finally:
        found.close()


def test_a_map_without_tiles_is_refused(tmp_path) -> None:
    with pytest.raises(ValueError, match="without tiles"):
        write_pmtiles(tmp_path / "map.pmtiles", {}, BOUNDS, {})
    assert not (tmp_path / "map.pmtiles").exists()
