"""A block of images that grows by one image at a time, tied by patches of its earlier images.

It holds orientations, object points and image points, and no image. Adjusted values are put into it
from outside (`processing.bundle.block_adjustment`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.initial_values import intersect
from processing.matching.block_matching import pixels_of, rays_of
from processing.matching.patch_tracks import (
    PatchMatching,
    Picture,
    cut_patches,
    features_in,
    grid_cells,
    match_to_picture,
)
from processing.matching.plane_rectification import quarter_rotations
from processing.rig import VirtualImage

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PROBES: Final = 48
"""Matched first, with the large search, for the common offset of an image's predictions."""
_MIN_PROBES: Final = 6
_NEAREST: Final = 4
"""Points whose heights predict that of a new feature."""
_FORGET_AFTER: Final = 6
"""Images after which a feature that was never found again is given up."""
_GROWTH: Final = 4096


@dataclass(frozen=True)
class GrowingSettings:
    """How a block grows.

    Attributes:
        patches: window and limits of a match.
        cells: columns and rows of the grid of features of an image.
        attempts_per_cell: points of the same line, and as many of other lines, tried in a cell.
        probe_search_px: around the predictions that the common offset of an image is found with.
        first_search_px: around a prediction without a known height.
        search_px: around others.
        max_patches: memory; the patches of the oldest points are given up beyond.
    """

    patches: PatchMatching = field(default_factory=PatchMatching)
    cells: tuple[int, int] = (12, 8)
    attempts_per_cell: int = 2
    probe_search_px: int = 40
    first_search_px: int = 24
    search_px: int = 6
    max_patches: int = 150_000


@dataclass(frozen=True)
class ImageTies:
    """What one image added.

    Attributes:
        tried, found: by name of the line of the point's earlier images.
        features: new features.
        offset_px: (2,) median of found less predicted, NaN where nothing was found.
    """

    tried: dict[str, int]
    found: dict[str, int]
    features: int
    offset_px: Array

    @property
    def matches(self) -> int:
        """Points of earlier images that were found."""
        return sum(self.found.values())


class GrowingBlock:
    """Images, points and image points so far.

    Args:
        image: geometry of all images.
        ground_m: height of the ground to begin with, in the frame of the orientations.
        settings: grid, searches and memory.

    Attributes:
        station_m: (3,) by image.
        rotation: (3, 3) from camera, by image.
        line: name by image.
        observed: by image, points (n,) and pixels (n, 2).
    """

    def __init__(
        self, image: VirtualImage, ground_m: float, settings: GrowingSettings | None = None
    ) -> None:
        self.image = image
        self.settings = settings or GrowingSettings()
        self.station_m: list[Array] = []
        self.rotation: list[Array] = []
        self.line: list[str] = []
        self.observed: list[tuple[Indices, Array]] = []
        self._ground_m = ground_m
        self._count = 0
        side = self.settings.patches.side_px
        self._patches = np.zeros((0, side, side), dtype=np.uint16)
        self._free: list[int] = []
        self._xyz_m = np.zeros((0, 3))
        self._known = np.zeros(0, dtype=bool)
        self._rays = np.zeros(0, dtype=np.int64)
        self._reference = np.zeros(0, dtype=np.int64)
        self._reference_px = np.zeros((0, 2))
        self._last_line = np.zeros(0, dtype=np.int64)
        self._slot = np.zeros(0, dtype=np.int64)
        self._line_index: dict[str, int] = {}
        size = (image.width_px, image.height_px)
        self._cells = grid_cells(size, self.settings.cells, self.settings.patches.margin_px + 2)

    @property
    def points(self) -> int:
        """Number of points, those that only one image sees among them."""
        return self._count

    @property
    def xyz_m(self) -> Array:
        """Coordinates of the points, shape (points, 3), m."""
        return self._xyz_m[: self._count]

    @property
    def rays(self) -> Indices:
        """Images that see each point, shape (points,)."""
        return self._rays[: self._count]

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Points whose place follows from two or more rays, shape (points,)."""
        return self._known[: self._count]

    @property
    def ground_m(self) -> float:
        """Height of the ground that the latest images show."""
        return self._ground_m

    @property
    def memory_bytes(self) -> int:
        """Size of patches and tables."""
        tables = (
            self._patches, self._xyz_m, self._known, self._rays, self._reference,
            self._reference_px, self._last_line, self._slot,
        )  # fmt: skip
        return sum(t.nbytes for t in tables) + sum(p.nbytes + px.nbytes for p, px in self.observed)

    def add(self, picture: Picture, station_m: Array, rotation: Array, line: str) -> ImageTies:
        """Tie an image to the earlier ones and take new features from it.

        Args:
            picture: (h, w), NaN without data.
            station_m: (3,) projection centre by direct georeferencing.
            rotation: (3, 3) from camera, likewise.
            line: name of the flight line.

        Returns:
            Counts of what was tried and found.

        Raises:
            ValueError: a picture of another size.
        """
        if picture.shape != (self.image.height_px, self.image.width_px):
            raise ValueError(
                f"the picture is {picture.shape}; images of this block are "
                f"({self.image.height_px}, {self.image.width_px})"
            )
        number = len(self.station_m)
        self.station_m.append(station_m)
        self.rotation.append(rotation)
        self.line.append(line)
        own_line = self._line_index.setdefault(line, len(self._line_index))
        chosen, predicted = self._candidates(station_m, rotation, own_line)
        lines = self._last_line[chosen].copy()
        at = self._match(chosen, predicted, rotation, picture)
        hit = np.isfinite(at).all(axis=1)
        found, found_px = chosen[hit], at[hit]
        self._intersect(found, found_px, number)
        self._rays[found] += 1
        self._last_line[found] = own_line
        features, feature_px = self._new_features(picture, number, found, found_px, own_line)
        self.observed.append(
            (np.concatenate([found, features]), np.concatenate([found_px, feature_px]))
        )
        self._forget(number)
        names = list(self._line_index)
        offset = np.median(found_px - predicted[hit], axis=0) if hit.any() else np.full(2, np.nan)
        return ImageTies(
            {names[k]: int((lines == k).sum()) for k in np.unique(lines)},
            {names[k]: int((lines[hit] == k).sum()) for k in np.unique(lines)},
            len(features),
            offset,
        )

    def reject(self, image: int, points: Indices) -> None:
        """Remove image points that an adjustment left out.

        Args:
            image: the image.
            points: points (k,) that it does not see after all.
        """
        own, px = self.observed[image]
        keep = ~np.isin(own, points)
        lost = own[~keep]
        self.observed[image] = (own[keep], px[keep])
        self._rays[lost] -= 1
        self._release(lost[self._rays[lost] < 1])

    def put(self, images: Sequence[int], station_m: Array, rotation: Array) -> None:
        """Replace orientations by adjusted ones.

        Args:
            images: which.
            station_m: (n, 3).
            rotation: (n, 3, 3) from camera.
        """
        for k, place, turn in zip(images, station_m, rotation, strict=True):
            self.station_m[k], self.rotation[k] = place, turn

    def put_points(self, points: Indices, xyz_m: Array) -> None:
        """Replace points by adjusted ones.

        Args:
            points: which, (n,).
            xyz_m: (n, 3).
        """
        self._xyz_m[points] = xyz_m
        self._known[points] = True

    def _candidates(
        self, station_m: Array, rotation: Array, own_line: int
    ) -> tuple[Indices, Array]:
        """Points to be tried, and their predicted pixels: the best of each cell and kind."""
        live = np.flatnonzero(self._slot[: self._count] >= 0)
        px = pixels_of(self.image, station_m, rotation, self._xyz_m[live])
        margin = self.settings.patches.margin_px + 2
        last = np.array([self.image.width_px - 1, self.image.height_px - 1])
        with np.errstate(invalid="ignore"):
            inside = ((px > margin) & (px < last - margin)).all(axis=1)
        live, px = live[inside], px[inside]
        if not len(live):
            return live, px
        cell = self._cell_of(px)
        other = (self._last_line[live] != own_line).astype(np.int64)
        # Points with a known height and many rays first, then the newest.
        order = np.lexsort((-live, -self._rays[live], ~self._known[live], other, cell))
        group = (cell * 2 + other)[order]
        first = np.searchsorted(group, group, side="left")
        rank = np.arange(len(group)) - first
        taken = np.sort(order[rank < self.settings.attempts_per_cell])
        return live[taken], px[taken]

    def _cell_of(self, px: Array) -> Indices:
        columns, rows = self.settings.cells
        low = np.array([self._cells[0, 0], self._cells[0, 2]])
        high = np.array([self._cells[-1, 1], self._cells[-1, 3]]) + 1
        at = np.clip(((px - low) / (high - low) * [columns, rows]).astype(np.int64), 0, None)
        return np.asarray(
            np.minimum(at[:, 1], rows - 1) * columns + np.minimum(at[:, 0], columns - 1)
        )

    def _match(self, chosen: Indices, predicted: Array, rotation: Array, picture: Picture) -> Array:
        """Pixels (n, 2) of the chosen points, NaN where they are not found."""
        at = np.full((len(chosen), 2), np.nan)
        if not len(chosen):
            return at
        quarter_of = {
            k: quarter_rotations(rotation, self.rotation[k])
            for k in np.unique(self._reference[chosen]).tolist()
        }
        quarters = np.array([quarter_of[k] for k in self._reference[chosen].tolist()])
        first = self.settings.first_search_px

        def run(rows: Indices, offset_px: Array, search_px: int) -> None:
            if len(rows):
                at[rows] = match_to_picture(
                    self._patches[self._slot[chosen[rows]]], quarters[rows],
                    predicted[rows] + offset_px, picture, search_px, self.settings.patches,
                )  # fmt: skip

        best = np.argsort(~self._known[chosen], kind="stable")
        probes = np.unique(best[:: max(1, len(best) // _PROBES)][:_PROBES])
        run(probes, np.zeros(2), self.settings.probe_search_px)
        rest = np.setdiff1d(np.arange(len(chosen)), probes)
        seen = probes[np.isfinite(at[probes]).all(axis=1)]
        if len(seen) < _MIN_PROBES:
            run(rest, np.zeros(2), first)
            return at
        offset = np.median(at[seen] - predicted[seen], axis=0)
        is_known = self._known[chosen[rest]]
        run(rest[is_known], offset, self.settings.search_px)
        run(rest[~is_known], offset, first)
        return at

    def _intersect(self, points: Indices, px: Array, number: int) -> None:
        """Place points that are seen for the second time."""
        new = np.flatnonzero(~self._known[points])
        if not len(new):
            return
        which = points[new]
        reference = self._reference[which]
        own = rays_of(self.image, self.rotation[number], px[new])
        other = np.array(
            [
                rays_of(self.image, self.rotation[k], self._reference_px[p][None])[0]
                for k, p in zip(reference, which, strict=True)
            ]
        )
        stations = np.concatenate(
            [
                np.array([self.station_m[k] for k in reference]),
                np.broadcast_to(self.station_m[number], (len(new), 3)),
            ]
        )
        at = np.tile(np.arange(len(new)), 2)
        xyz, _ = intersect(len(new), at, stations, np.concatenate([other, own]))
        good = np.isfinite(xyz).all(axis=1)
        self._xyz_m[which[good]] = xyz[good]
        self._known[which[good]] = True

    def _new_features(
        self, picture: Picture, number: int, found: Indices, found_px: Array, own_line: int
    ) -> tuple[Indices, Array]:
        """Features of the cells without a point."""
        free = np.ones(len(self._cells), dtype=bool)
        if len(found):
            free[self._cell_of(found_px)] = False
        places = features_in(picture, self._cells[free], self.settings.patches)
        patches, whole = cut_patches(picture, places, self.settings.patches)
        px = places[whole].astype(np.float64)
        if not len(px):
            return np.zeros(0, dtype=np.int64), px
        rays = rays_of(self.image, self.rotation[number], px)
        place = self.station_m[number]
        ground = np.full(len(px), self._ground_m)
        own = found[self._known[found]]
        for _ in range(2):  # where a ray meets the ground depends on its height
            xyz = place + rays * ((ground - place[2]) / rays[:, 2])[:, None]
            if len(own) < _NEAREST:
                break
            away = np.hypot(*(xyz[:, None, :2] - self._xyz_m[own][None, :, :2]).transpose(2, 0, 1))
            near = np.argsort(away, axis=1)[:, :_NEAREST]
            ground = np.median(self._xyz_m[own][near, 2], axis=1)
        if len(own) >= _NEAREST:
            self._ground_m = float(np.median(self._xyz_m[own, 2]))
        first = self._count
        self._extend(len(px))
        new = np.arange(first, first + len(px))
        self._xyz_m[new], self._rays[new], self._reference[new] = xyz, 1, number
        self._reference_px[new], self._last_line[new] = px, own_line
        self._slot[new] = self._store(patches)
        return new, px

    def _extend(self, count: int) -> None:
        needed = self._count + count
        if needed > len(self._rays):
            more = max(_GROWTH, needed - len(self._rays))
            self._xyz_m = np.concatenate([self._xyz_m, np.zeros((more, 3))])
            self._reference_px = np.concatenate([self._reference_px, np.zeros((more, 2))])
            self._known = np.concatenate([self._known, np.zeros(more, dtype=bool)])
            for name in ("_rays", "_reference", "_last_line"):
                setattr(self, name, np.concatenate([getattr(self, name), np.zeros(more, np.int64)]))
            self._slot = np.concatenate([self._slot, np.full(more, -1, dtype=np.int64)])
        self._count = needed

    def _store(self, patches: NDArray[np.uint16]) -> Indices:
        limit = self.settings.max_patches
        missing = len(patches) - len(self._free)
        room = limit - len(self._patches)
        if missing > room:
            self._give_up_oldest(missing - max(room, 0))
        missing = len(patches) - len(self._free)
        if missing > 0:
            more = min(max(_GROWTH, missing), limit - len(self._patches))
            begin = len(self._patches)
            side = self.settings.patches.side_px
            new = np.zeros((more, side, side), dtype=np.uint16)
            self._patches = np.concatenate([self._patches, new])
            self._free.extend(range(begin + more - 1, begin - 1, -1))
        slots = np.array([self._free.pop() for _ in range(len(patches))], dtype=np.int64)
        self._patches[slots] = patches
        return slots

    def _give_up_oldest(self, count: int) -> None:
        live = np.flatnonzero(self._slot[: self._count] >= 0)
        self._release(live[:count])

    def _release(self, points: Indices) -> None:
        """Give up patches."""
        held = points[self._slot[points] >= 0]
        self._free.extend(self._slot[held].tolist())
        self._slot[held] = -1

    def _forget(self, number: int) -> None:
        live = np.flatnonzero(self._slot[: self._count] >= 0)
        alone = live[(self._rays[live] < 2) & (self._reference[live] <= number - _FORGET_AFTER)]
        self._release(alone)
