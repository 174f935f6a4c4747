"""The orthomosaic of a block that grows: images with orientations in, changed map tiles out.

Each cell of the map is taken from the image that was nearest above it. An image that came is placed
at once; at the end of a line all images are levelled, and what moved is computed again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.onboard.live_orthomosaic.block_gains import (
    gain_on_arrival,
    level_images,
    owners_of,
)
from daemon.onboard.live_orthomosaic.map_ground import MapGround
from daemon.onboard.live_orthomosaic.map_layout import TileId, world_tile
from daemon.onboard.live_orthomosaic.placed_image import (
    CELL_PX,
    PlacedImage,
    corners_in_map,
    covered_cells,
    flat_gain,
    reduced_by,
)
from daemon.onboard.live_orthomosaic.tile_files import TileFiles, merged
from daemon.onboard.live_orthomosaic.web_tiles import (
    gsd_m,
    map_grid,
    map_px,
    map_surface,
    zoom_of,
)
from daemon.onboard.monitoring.maps.tiles import TILE_PX
from daemon.orientation.local_frame import LocalFrame
from processing.image.orthoimage.ground_grid import GroundGrid, ground_surface
from processing.image.orthoimage.ground_resampling import ImagePose, resample_to_ground
from processing.pipelines.live_triangulation import LiveOrientation
from processing.radiometry.tone_curve import histogram, lookup_table, mission_curve
from processing.rig import VirtualImage

Array = NDArray[np.float64]

GSD_FACTOR: Final = 8.0
"""Of the image's ground sampling distance, where none is configured."""
MAP_WIDTH_PX: Final = 512
"""An image is at most about so wide on the map, where no sampling distance is configured."""
BYTES_PER_EXPOSURE: Final = 60_000
MOVED_PX: Final = 0.5
CHANGED: Final = 0.02
"""A tile that moved or changed by so much is published again in flight."""
LINE_END_MOVED_PX: Final = 0.05
LINE_END_CHANGED: Final = 0.002
"""At the end of a line, what moved or changed by more."""
OVERVIEWS: Final = 5
"""Coarser levels."""
SURVEYED_PX: Final = 4.0
"""An image that moved by more covers other cells."""
LEVELLED_MAX: Final = 300
"""Latest images that are levelled at once."""
TONE_STEP: Final = 10.0
"""Mean difference of 8-bit values at which a new tone curve replaces the present one."""
_WORD_MAX: Final = 65535.0


@dataclass(frozen=True)
class PublishedTile:
    """A picture with its version and its size in bytes."""

    tile: TileId
    version: int
    size: int


class LiveOrthomosaic:
    """The map of one block.

    Args:
        files: where tiles are.
        image: geometry of the images.
        frame: local frame of the orientations.
        wanted_gsd_m: of the map; None: several times that of the images.

    Attributes:
        images: as placed, in the order in which they came.
        ground: under the map.
        zoom: level of the finest tiles; set by the first image.
        not_placed: reasons by exposure.
    """

    def __init__(
        self,
        files: TileFiles,
        image: VirtualImage,
        frame: LocalFrame,
        ground: MapGround,
        wanted_gsd_m: float | None = None,
    ) -> None:
        self.files, self.image, self.frame, self.ground = files, image, frame, ground
        self.images: list[PlacedImage] = []
        self.not_placed: dict[int, str] = {}
        self.zoom = -1
        self.gsd_m = math.nan
        self._wanted_gsd_m = wanted_gsd_m
        self._seen: dict[int, LiveOrientation] = {}
        self._at: dict[int, int] = {}
        self._by_tile: dict[tuple[int, int], list[int]] = {}
        self._table: NDArray[np.uint8] | None = None

    def add(
        self,
        orientation: LiveOrientation,
        pixels: NDArray[np.uint16],
        others: Iterable[LiveOrientation] = (),
    ) -> list[PublishedTile]:
        """Place an image, and compute again what moved.

        Args:
            orientation: of the image.
            pixels: (h, w), 0 is no data.
            others: orientations of all images, as they are now.

        Returns:
            Tiles that were published, coarse ones first; at most `BYTES_PER_EXPOSURE` together.
        """
        if orientation.image.number in self._at:
            return []
        self.place(orientation, pixels, others)
        return self._publish(CHANGED, BYTES_PER_EXPOSURE)

    def place(
        self,
        orientation: LiveOrientation,
        pixels: NDArray[np.uint16],
        others: Iterable[LiveOrientation] = (),
    ) -> None:
        """As `add`, without publishing a tile."""
        if orientation.image.number in self._at:
            return
        dirty = self._place(orientation, pixels)
        moved = self._follow(others, MOVED_PX)
        self._render(dirty | moved, moved=moved)

    def knows(self, number: int) -> bool:
        """Whether an exposure is in the map, or has a reason why it is not."""
        return number in self._at or number in self.not_placed

    def level(self, orientations: Sequence[LiveOrientation], ground: MapGround) -> None:
        """After an adjustment of the block: level the images, follow their orientations, and
        compute what changed. `publish_levelled` publishes it.

        Args:
            orientations: of all images.
            ground: as it is known now.
        """
        if self.zoom < 0:
            return
        before_ground, self.ground = self.ground, ground
        if ground != before_ground:
            for image in self.images:
                image.ground_m = self._ground_below(image.pose)
        before = {id(image): image.gain for image in self.images}
        levelled = level_images(self.images[-LEVELLED_MAX:])
        changed = {
            self._at[image.number]
            for image in levelled
            if _gain_step(image, before[id(image)]) > LINE_END_CHANGED
        }
        dirty = self._follow(orientations, LINE_END_MOVED_PX)
        dirty |= {tile for k in changed for tile in self._tiles_of(self.images[k])}
        self._render(dirty, moved=set())
        self._set_tone()

    def publish_levelled(self, limit_bytes: float = math.inf) -> list[PublishedTile]:
        """Publish what changed, coarse tiles first."""
        return self._publish(LINE_END_CHANGED, limit_bytes)

    @property
    def pending(self) -> int:
        """Tiles that changed by `CHANGED` and are not published."""
        return sum(1 for s in self.files.states.values() if s.has_moved or s.changed >= CHANGED)

    @property
    def tiles(self) -> list[TileId]:
        """The finest tiles."""
        return sorted(tile for tile in self.files.states if tile[0] == self.zoom)

    def as_json(self) -> dict[str, Any]:
        """What the map is."""
        return {
            "zoom": self.zoom,
            "min_zoom": max(self.zoom - OVERVIEWS, 0),
            "gsd_m": None if self.zoom < 0 else round(self.gsd_m, 4),
            "ground": self.ground.as_json(),
            "images": len(self.images),
            "measured_only": sum(image.is_measured for image in self.images),
            "not_placed": len(self.not_placed),
            "version": self.files.version,
        }

    # Placing

    def _place(self, orientation: LiveOrientation, pixels: NDArray[np.uint16]) -> set[TileId]:
        number = orientation.image.number
        pose = self._pose(orientation)
        ground_m = self._ground_below(pose)
        place = self.frame.to_geodetic(pose.centre_m[None])[0]
        above = float(place[2]) - ground_m
        if above <= 1.0:
            self.not_placed[number] = "the ground is not below the camera"
            return set()
        own_gsd = above * self.image.pitch_mm / self.image.f_mm
        if self.zoom < 0:
            factor = max(GSD_FACTOR, self.image.width_px / MAP_WIDTH_PX)
            self.zoom = zoom_of(self._wanted_gsd_m or factor * own_gsd, float(place[0]))
            self.gsd_m = gsd_m(self.zoom, float(place[0]))
        factor_px = max(int(self.gsd_m / own_gsd + 1e-9), 1)
        small = reduced_by(pixels, factor_px)
        if not small.any():
            self.not_placed[number] = "no pixel has data"
            return set()
        pose = pose.reduced(factor_px)
        corners = corners_in_map(pose, ground_m, self.frame, self.zoom)
        if corners is None:
            self.not_placed[number] = "it looks too far from the vertical"
            return set()
        levels = covered_cells(small, pose, corners, self.zoom, self.ground, self.frame)
        one = PlacedImage(
            number, pose, ground_m, corners, self._nadir(pose), levels, flat_gain(levels)
        )
        near = {k for tile in self._tiles_of(one) for k in self._by_tile.get(tile[1:], ())}
        log_gain = gain_on_arrival(levels, [self.images[k] for k in sorted(near)])
        if log_gain is None and self.images:
            log_gain = float(self.images[-1].gain.log_gain.mean())
        one.gain = flat_gain(levels, log_gain or 0.0)
        one.is_measured = orientation.source == "measured"
        self.files.put_image(number, small)
        self._at[number] = len(self.images)
        self._seen[number] = orientation
        self.images.append(one)
        self._index(self._at[number])
        if self._table is None:
            self._table = _table(histogram(small))
        return self._tiles_of(one)

    def _pose(self, orientation: LiveOrientation) -> ImagePose:
        image = self.image
        return ImagePose(
            image.f_mm, image.pitch_mm, image.width_px, image.height_px,
            orientation.position_m, orientation.rotation,
        )  # fmt: skip

    def _ground_below(self, pose: ImagePose) -> float:
        latitude, longitude, _ = self.frame.to_geodetic(pose.centre_m[None])[0]
        return float(self.ground.heights_m(np.array([[latitude]]), np.array([[longitude]]))[0, 0])

    def _nadir(self, pose: ImagePose) -> Array:
        place = self.frame.to_geodetic(pose.centre_m[None])
        return np.asarray(map_px(self.zoom, place[:, 0], place[:, 1], self.frame.longitude_deg)[0])

    def _tiles_of(self, image: PlacedImage) -> set[TileId]:
        rows, columns = image.covered
        cells = TILE_PX // CELL_PX
        return {
            (self.zoom, x, y)
            for y in range(rows.start // cells, (rows.stop - 1) // cells + 1)
            for x in range(columns.start // cells, (columns.stop - 1) // cells + 1)
        }

    def _index(self, k: int) -> None:
        for _, x, y in self._tiles_of(self.images[k]):
            own = self._by_tile.setdefault((x, y), [])
            if k not in own:
                own.append(k)

    def _follow(self, orientations: Iterable[LiveOrientation], limit_px: float) -> set[TileId]:
        """Take over orientations that moved an image by more than a limit, or whose ground did."""
        dirty: set[TileId] = set()
        for one in orientations:
            k = self._at.get(one.image.number)
            if k is None or (limit_px >= MOVED_PX and self._seen[one.image.number] is one):
                continue
            self._seen[one.image.number] = one
            image = self.images[k]
            pose = replace(image.pose, centre_m=one.position_m, rotation=one.rotation)
            corners = corners_in_map(pose, image.ground_m, self.frame, self.zoom)
            if corners is None:
                continue
            image.is_measured = one.source == "measured"
            moved = float(np.hypot(*(corners - image.corners_px).T).max())
            if moved < limit_px:
                continue
            dirty |= self._tiles_of(image)
            image.pose, image.corners_px = pose, corners
            image.nadir_px = self._nadir(pose)
            if moved > SURVEYED_PX:
                image.levels = covered_cells(
                    self.files.image(image.number),
                    pose,
                    corners,
                    self.zoom,
                    self.ground,
                    self.frame,
                )
                self._index(k)
                dirty |= self._tiles_of(image)
        return dirty

    # Pixels

    def _render(self, dirty: set[TileId], *, moved: set[TileId]) -> None:
        changed = {
            tile
            for tile in sorted(dirty)
            if self.files.put(tile, self._pixels(tile), has_moved=tile in moved)
        }
        for _ in range(min(OVERVIEWS, self.zoom)):
            parents = {_parent(tile) for tile in changed}
            changed = {
                tile
                for tile in sorted(parents)
                if self.files.put(tile, merged([self.files.signal(c) for c in _children(tile)]))
            }

    def _pixels(self, tile: TileId) -> NDArray[np.uint16]:
        """Pixels of one of the finest tiles, each cell from the image nearest above it."""
        _, x, y = tile
        cells = TILE_PX // CELL_PX
        known = self._by_tile.get((x, y), [])
        images = [self.images[k] for k in known]
        owner = owners_of(
            images, slice(y * cells, (y + 1) * cells), slice(x * cells, (x + 1) * cells)
        )
        owner = owner.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)
        grid = map_grid(self.zoom, x * TILE_PX, y * TILE_PX, TILE_PX, TILE_PX)
        surface = map_surface(grid, self.ground, self.frame)
        along = (np.arange(TILE_PX) + 0.5) / CELL_PX - 0.5
        result = np.zeros((TILE_PX, TILE_PX), np.uint16)
        for k in np.unique(owner[owner >= 0]).tolist():
            image, wanted = images[k], owner == k
            found = resample_to_ground(
                self.files.image(image.number)[None], image.pose, surface, wanted=wanted
            )
            filled = wanted & (found[0] > 0.0)
            found = image.gain.levelled(found, y * cells + along, x * cells + along)
            result[filled] = np.clip(np.rint(found[0][filled]), 1.0, _WORD_MAX)
        return result

    def _set_tone(self) -> None:
        """Take another tone curve where the block shows other light than the present one."""
        counts = np.zeros(65536, np.int64)
        tiles = self.tiles
        for tile in tiles[:: max(len(tiles) // 64, 1)]:
            signal = self.files.signal(tile)
            if signal is not None:
                counts += histogram(signal)
        if not counts.any():
            return
        table = _table(counts)
        assert self._table is not None
        weight = counts / counts.sum()
        step = float((np.abs(table.astype(float) - self._table) * weight).sum())
        if step > TONE_STEP:
            self._table = table
            for state in self.files.states.values():
                state.changed += CHANGED

    def _publish(self, changed: float, limit_bytes: float) -> list[PublishedTile]:
        if self._table is None:
            return []
        wanted = sorted(
            (tile[0], state.version, tile)
            for tile, state in self.files.states.items()
            if state.has_moved or state.changed >= changed
        )
        published: list[PublishedTile] = []
        total = 0
        for _, _, tile in wanted:
            picture = self.files.picture(tile, self._table)
            total += len(picture)
            if total > limit_bytes and published:
                break
            version = self.files.publish(tile, picture)
            published.append(PublishedTile(world_tile(tile), version, len(picture)))
        return published


def warm_up() -> None:
    """Compile, or load, the kernels that the map calls."""
    surface = ground_surface(GroundGrid(0.0, 0.0, 1.0, 8, 8), 0.0)
    pose = ImagePose(100.0, 0.1, 8, 8, np.array([0.0, 0.0, 1000.0]), np.eye(3))
    resample_to_ground(np.ones((1, 8, 8), np.uint16), pose, surface)
    resample_to_ground(np.ones((1, 8, 8), np.uint16), pose, surface, interpolation="bilinear")


def _gain_step(image: PlacedImage, before: Any) -> float:
    """Largest change of the logarithm of the gain of an image."""
    rows, columns = image.covered
    places = (
        np.linspace(rows.start, rows.stop - 1, 5),
        np.linspace(columns.start, columns.stop - 1, 5),
    )
    signal = np.full((1, 5, 5), float(np.exp(np.nanmean(image.levels.log_signal))))
    now, then = image.gain.levelled(signal, *places), before.levelled(signal, *places)
    return float(np.abs(np.log(now / then)).max())


def _table(counts: NDArray[np.int64]) -> NDArray[np.uint8]:
    return np.asarray(lookup_table(mission_curve({"pan": counts}), "pan"))


def _parent(tile: TileId) -> TileId:
    return tile[0] - 1, tile[1] // 2, tile[2] // 2


def _children(tile: TileId) -> list[TileId]:
    zoom, x, y = tile[0] + 1, 2 * tile[1], 2 * tile[2]
    return [(zoom, x, y), (zoom, x + 1, y), (zoom, x, y + 1), (zoom, x + 1, y + 1)]
