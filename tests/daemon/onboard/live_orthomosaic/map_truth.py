"""The live map held against the ideal orthoimage of the emulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.orthomosaic import shift_between
from daemon.onboard.live_orthomosaic.block_gains import owners_of
from daemon.onboard.live_orthomosaic.live_orthomosaic import LiveOrthomosaic
from daemon.onboard.live_orthomosaic.placed_image import CELL_PX
from daemon.onboard.live_orthomosaic.web_tiles import geodetic_of_mercator, map_grid
from daemon.onboard.monitoring.maps.tiles import TILE_PX
from daemon.orientation.local_frame import LocalFrame
from sim_hw.world.flight import SimulatedFlight
from sim_hw.world.rendering import GRID_PX, sample_scene, scene_positions
from sim_hw.world.scene import Scene
from sim_hw.world.world import World

Array = NDArray[np.float64]

WINDOW_PX = 32
FINER = 8
"""Samples along a map pixel: the ideal orthoimage is their mean."""


@dataclass(frozen=True)
class MapTruth:
    """The emulated ground under a map."""

    world: World
    scene: Scene
    flight: SimulatedFlight

    def heights_m(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        """True heights above the ellipsoid."""
        shape = np.shape(latitude_deg)
        return self._ground(np.ravel(latitude_deg), np.ravel(longitude_deg))[1].reshape(shape)

    def as_json(self) -> dict:
        return {"kind": "height model"}

    def orthoimage(self, zoom: int, column: int, row: int) -> Array:
        """Ideal window of a map, (WINDOW_PX, WINDOW_PX) radiances."""
        grid = map_grid(zoom, column, row, WINDOW_PX, WINDOW_PX)
        step = grid.gsd_m / FINER
        first = (grid.east_m - grid.gsd_m / 2 + step / 2, grid.north_m + grid.gsd_m / 2 - step / 2)
        size = WINDOW_PX * FINER
        nodes = np.arange(-(-size // GRID_PX) + 1) * GRID_PX * step
        east, north = np.meshgrid(first[0] + nodes, first[1] - nodes)
        latitude, longitude = geodetic_of_mercator(east, north)
        local, _ = self._ground(latitude.ravel(), longitude.ravel())
        at = scene_positions(self.world, self.scene, self.flight, local.reshape(*east.shape, 3))
        fine = sample_scene(self.scene, "pan", at, (size, size)).astype(np.float64)
        return fine.reshape(WINDOW_PX, FINER, WINDOW_PX, FINER).mean(axis=(1, 3))

    def _ground(self, latitude: Array, longitude: Array) -> tuple[Array, Array]:
        plan = self.flight.plan
        frame = LocalFrame(plan.latitude_deg, plan.longitude_deg)
        height = np.full(latitude.shape, float(plan.ground_height_m))
        for _ in range(4):
            local = frame.from_geodetic(latitude, longitude, height)
            local[:, 2] -= plan.ground_height_m
            height += self.world.terrain.height_m(local[:, 0], local[:, 1]) - local[:, 2]
        return local, height


def displacements(live: LiveOrthomosaic, truth: MapTruth) -> dict[str, float]:
    """Displacement of windows, and of both sides of a seam against each other, map pixels."""
    whole, across = [], []
    cells = TILE_PX // CELL_PX
    for tile in live.tiles:
        _, x, y = tile
        signal = live.files.signal(tile)
        owner = owners_of(
            live.images, slice(y * cells, (y + 1) * cells), slice(x * cells, (x + 1) * cells)
        )
        owner = owner.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)
        for row in range(0, TILE_PX, WINDOW_PX):
            for column in range(0, TILE_PX, WINDOW_PX):
                part = np.s_[row : row + WINDOW_PX, column : column + WINDOW_PX]
                a, who = signal[part].astype(np.float64), owner[part]
                if (a == 0).any():
                    continue
                b = truth.orthoimage(live.zoom, x * TILE_PX + column, y * TILE_PX + row)
                b *= a.mean() / b.mean()
                whole.append(shift_between(a, b, np.ones_like(a, bool)))
                names = np.unique(who)
                if len(names) == 2:
                    sides = [shift_between(a, b, who == k) for k in names]
                    if sides[0] is not None and sides[1] is not None:
                        across.append(sides[0] - sides[1])
    found = np.array([one for one in whole if one is not None]).reshape(-1, 2)
    seams = np.array(across).reshape(-1, 2)
    return {
        "windows": len(found),
        "rms_px": float(np.sqrt((found**2).sum(axis=1).mean())),
        "seam_windows": len(seams),
        "seam_rms_px": float(np.sqrt((seams**2).sum(axis=1).mean())) if len(seams) else np.nan,
    }
