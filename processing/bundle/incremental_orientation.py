"""Orientation of images of which nothing is known, one after the other, from a first pair.

Relative orientation of a pair, intersection of its points, resection of the next image, adjustment
with self-calibration, until no image is left that sees enough points. The frame is that of the
first image and has no scale; a similarity brings it to known positions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.bundle.camera_model import ideal_mm
from processing.bundle.damped_adjustment import FreeBlock, damped_adjustment
from processing.bundle.initial_values import intersect
from processing.bundle.network import CameraModel
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

POINTS_MIN: Final = 20
"""Object points that an image must see to be oriented."""
_VISION = np.diag([1.0, -1.0, -1.0])
_PARALLAX_MIN_RAD: Final = np.radians(2.0)
_PAIRS_TRIED: Final = 8
_PAIRS_MEASURED: Final = 2000
_GROUPS_TRIED: Final = 4
"""Images of different ground, or of ground that repeats itself, make groups of their own."""
_TURNED_MAX_PX: Final = 6.0
"""Images that differ by a rotation but for this were taken from one place."""
_TRIAL_IMAGES: Final = 5
"""Images that each relative orientation of a first pair is tried with."""
_ADJUSTED_EACH: Final = 6
_SHIFT_MIN: Final = 0.05
"""Shortest base of a first pair over the distance of its plane."""
_RESIDUAL_MAX_PX: Final = 4.0
_FIRST_RESIDUAL_MAX_PX: Final = 12.0
_INTERIOR_FROM: Final = 4
"""Images from which on the interior orientation is estimated."""
_GROWTH: Final = 1.25
"""The block is adjusted again when it has grown by this factor."""


@dataclass(frozen=True)
class PhotographTracks:
    """Image points of tracks: image (n,), point (n,), measured xy (n, 2) mm, y up; counts.

    `camera` is the camera of each image, (images,); None: the first of all.
    """

    image: Indices
    point: Indices
    xy_mm: Array
    images: int
    points: int
    camera: Indices | None = None

    @property
    def camera_of(self) -> Indices:
        """Camera of each image, (images,)."""
        return np.zeros(self.images, np.int64) if self.camera is None else self.camera


@dataclass(frozen=True)
class OrientedBlock:
    """Images in a frame without scale.

    `station` (images, 3), `rotation` (images, 3, 3) object from camera, `xyz` (points, 3): NaN
    where not known. `interior` (cameras, 10). `used` (n,) marks the image points that fit. `seen`
    (images,) counts object points that an image without orientation sees.
    """

    station: Array
    rotation: Array
    xyz: Array
    interior: Array
    used: Flags
    seen: Indices

    @property
    def oriented(self) -> Flags:
        """Images with an orientation, (images,)."""
        return np.asarray(np.isfinite(self.station[:, 0]))


def orient_photographs(
    cameras: Sequence[CameraModel],
    tracks: PhotographTracks,
    *,
    progress: Callable[[int], None] = lambda _done: None,
) -> OrientedBlock | None:
    """Orient as many images as hang together.

    Args:
        cameras: provisional interior orientations with pixel size; `free`, the same of all, names
            what is estimated on the way, `sigma` how well it is known.
        tracks: image points of all images.
        progress: called with the number of oriented images.

    Returns:
        Orientations; None where no pair of images can be oriented.

    Source: docs/explanation/mathematics/bundle.md#orientation-without-attitudes.
    """
    cv2.setRNGSeed(1)
    block = _best_start(tuple(cameras), tracks)
    if block is None:
        return None
    block.grow(tracks.images, progress)
    seen = np.array([len(block.known_rows(k)) for k in range(tracks.images)], np.int64)
    return OrientedBlock(
        block.station, block.rotation, block.xyz, block.interior, block.used(), seen
    )


def _best_start(cameras: tuple[CameraModel, ...], tracks: PhotographTracks) -> _Growing | None:
    """The few images of the first pair that grows, with the relative orientation that fits most."""
    best, most = None, 0
    for pairs in _Growing(cameras, tracks).pairs():
        for start in (start for pair in pairs for start in _starts(cameras, tracks, pair)):
            trial = _Growing(cameras, tracks)
            if not trial.begin(start):
                continue
            trial.grow(_TRIAL_IMAGES, lambda _done: None)
            fitting = int(trial.used().sum())
            if fitting > most:
                best, most = trial, fitting
        if best is not None and best.oriented.sum() >= _TRIAL_IMAGES:
            break
    return best


class _Growing:
    """A block while images are added to it. Rotations are object from our camera axes."""

    def __init__(self, cameras: tuple[CameraModel, ...], tracks: PhotographTracks) -> None:
        self.cameras, self.tracks = cameras, tracks
        self.interior = np.array([camera.interior for camera in cameras])
        pixel = np.array([(one.pixel_mm or 1e-3) / one.f_mm for one in cameras])
        # Size of a pixel of each image in the plane at distance one.
        self.pixel = pixel[tracks.camera_of]
        self.station = np.full((tracks.images, 3), np.nan)
        self.rotation = np.full((tracks.images, 3, 3), np.nan)
        self.xyz = np.full((tracks.points, 3), np.nan)
        self.limit_px = _FIRST_RESIDUAL_MAX_PX
        self.refused: dict[int, int] = {}
        order = np.argsort(tracks.image, kind="stable")
        bounds = np.searchsorted(tracks.image[order], np.arange(tracks.images + 1))
        self._rows = [order[a:b] for a, b in pairwise(bounds)]
        self._place()

    @property
    def oriented(self) -> Flags:
        return np.asarray(np.isfinite(self.station[:, 0]))

    def _place(self) -> None:
        """Ideal directions (n, 2) in vision axes, x / z and y / z, by the present interior."""
        self.ideal = np.empty_like(self.tracks.xy_mm)
        of_row = self.tracks.camera_of[self.tracks.image]
        for k, (camera, interior) in enumerate(zip(self.cameras, self.interior, strict=True)):
            rows = np.flatnonzero(of_row == k)
            terms = np.zeros(len(camera.terms))
            ideal = ideal_mm(camera, interior, terms, self.tracks.xy_mm[rows])
            self.ideal[rows] = ideal * np.array([1.0, -1.0]) / camera.f_mm

    def begin(self, start: _Start) -> bool:
        """Orient a first pair; False where too few points intersect under a good angle."""
        self.station[start.first], self.rotation[start.first] = 0.0, _VISION
        self.station[start.second] = -start.rotation.T @ start.shift
        self.rotation[start.second] = start.rotation.T @ _VISION
        self._intersect()
        return int(np.isfinite(self.xyz[:, 0]).sum()) >= POINTS_MIN

    def grow(self, images: int, progress: Callable[[int], None]) -> None:
        """Orient further images, adjusting as the block grows, up to so many."""
        adjusted_at = 0
        while True:
            count = int(self.oriented.sum())
            progress(count)
            if count < _ADJUSTED_EACH or count >= _GROWTH * adjusted_at:
                self.adjust()
                adjusted_at = count
            if count >= images:
                return
            if self.add_next():
                continue
            # With better values and points more images may fit.
            self.adjust()
            if not self.add_next():
                return

    def pairs(self) -> Iterator[list[_Pair]]:
        """Pairs to begin with: many common points, seen from different places.

        Yields one of each of the largest groups of connected images, then a second one, and so on.
        """
        groups = [self._pairs_of(group) for group in _by_common_points(self.tracks)]
        for k in range(_PAIRS_TRIED):
            yield [pairs[k] for pairs in groups if k < len(pairs)]

    def _pairs_of(self, group: list[tuple[int, int]]) -> list[_Pair]:
        """Those with an image that no pair before them has are first, those of one place last."""
        first: list[_Pair] = []
        repeated: list[_Pair] = []
        turned: list[_Pair] = []
        begun: set[int] = set()
        for a, b in group[:_PAIRS_MEASURED]:
            _, at, bt = np.intersect1d(
                self.tracks.point[self._rows[a]],
                self.tracks.point[self._rows[b]],
                assume_unique=True,
                return_indices=True,
            )
            pair = _Pair(a, b, self._rows[a][at], self._rows[b][bt])
            if self._turned_px(pair.first_rows, pair.second_rows) < _TURNED_MAX_PX:
                turned.append(pair)
                continue
            (repeated if {a, b} <= begun else first).append(pair)
            begun |= {a, b}
            if len(first) == _PAIRS_TRIED:
                break
        return [*first, *repeated, *turned][:_PAIRS_TRIED]

    def _turned_px(self, a: Indices, b: Indices) -> float:
        """Median residual of a rotation between two images: small where they have one place."""
        first, second = (np.column_stack([self.ideal[rows], np.ones(len(rows))]) for rows in (a, b))
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second /= np.linalg.norm(second, axis=1, keepdims=True)
        u, _, vt = np.linalg.svd(second.T @ first)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        away = np.linalg.norm(first @ turn.T - second, axis=1)
        return float(np.median(away) / self.pixel[self.tracks.image[a[0]]])

    def known_rows(self, image: int) -> Indices:
        """Rows of an image whose object points are known."""
        rows = self._rows[image]
        return np.asarray(rows[np.isfinite(self.xyz[self.tracks.point[rows], 0])])

    def add_next(self) -> bool:
        """Orient the image that sees the most known points; False if none can be oriented."""
        waiting = [(len(self.known_rows(k)), k) for k in np.flatnonzero(~self.oriented).tolist()]
        for count, k in sorted(waiting, reverse=True):
            if count < POINTS_MIN or self.refused.get(k, 0) >= count:
                continue
            if self._resect(k):
                self._intersect()
                return True
            self.refused[k] = count
        return False

    def _resect(self, image: int) -> bool:
        rows = self.known_rows(image)
        known = self.xyz[self.tracks.point[rows]]
        try:
            found, rotation, shift, inside = cv2.solvePnPRansac(
                known, self.ideal[rows], np.eye(3), None, iterationsCount=2000, confidence=0.9999,
                reprojectionError=self.limit_px * self.pixel[image], flags=cv2.SOLVEPNP_SQPNP,
            )  # fmt: skip
        except cv2.error:
            # Quirk: points of one place, from wrong tracks, end in an assertion of OpenCV.
            # Upstream: no report known (2026-11-24); computeOmega in sqpnp.cpp of OpenCV 5.0.
            return False
        if not found or inside is None or len(inside) < max(POINTS_MIN, 0.3 * len(rows)):
            return False
        own = inside.ravel()
        rotation, shift = cv2.solvePnPRefineLM(
            known[own], self.ideal[rows[own]], np.eye(3), None, rotation, shift
        )
        object_from_vision = rotations_from_vectors(rotation.ravel()).T
        self.station[image] = (-object_from_vision @ shift).ravel()
        self.rotation[image] = object_from_vision @ _VISION
        return True

    def _intersect(self) -> None:
        """All points that two oriented images see under a good angle and with small residuals."""
        tracks = self.tracks
        rows = np.flatnonzero(self.oriented[tracks.image])
        for _ in range(2):
            image, point = tracks.image[rows], tracks.point[rows]
            rays = self._rays(rows)
            xyz, _ = intersect(tracks.points, point, self.station[image], rays)
            residual = self._residual_px(xyz, rows)
            rows = rows[residual < self.limit_px]
        good = np.bincount(tracks.point[rows], minlength=tracks.points) >= 2
        good &= self._parallax(rows) > _PARALLAX_MIN_RAD
        xyz[~good] = np.nan
        self.xyz = xyz

    def _rays(self, rows: Indices) -> Array:
        vision = np.column_stack([self.ideal[rows], np.ones(len(rows))])
        rays = np.einsum("nij,nj->ni", self.rotation[self.tracks.image[rows]] @ _VISION, vision)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def _residual_px(self, xyz: Array, rows: Indices) -> Array:
        image, point = self.tracks.image[rows], self.tracks.point[rows]
        seen = np.einsum("nji,nj->ni", self.rotation[image], xyz[point] - self.station[image])
        with np.errstate(all="ignore"):
            place = seen[:, :2] * np.array([-1.0, 1.0]) / seen[:, 2:]
        residual = np.linalg.norm(place - self.ideal[rows], axis=1) / self.pixel[image]
        return np.where((seen[:, 2] < 0.0) & np.isfinite(residual), residual, np.inf)

    def _parallax(self, rows: Indices) -> Array:
        """The largest angle of the rays of each point against their mean, doubled, rad."""
        point, rays = self.tracks.point[rows], self._rays(rows)
        mean = np.zeros((self.tracks.points, 3))
        np.add.at(mean, point, rays)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        angle = np.arccos(np.clip(np.einsum("ni,ni->n", rays, mean[point]), -1.0, 1.0))
        largest = np.zeros(self.tracks.points)
        np.maximum.at(largest, point, angle)
        return 2.0 * largest

    def used(self) -> Flags:
        """Image points of oriented images that fit."""
        own = self.oriented[self.tracks.image] & np.isfinite(self.xyz[self.tracks.point, 0])
        rows = np.flatnonzero(own)
        own[rows] = self._residual_px(self.xyz, rows) < self.limit_px
        count = np.bincount(self.tracks.point[own], minlength=self.tracks.points)
        return np.asarray(own & (count[self.tracks.point] >= 2))

    def adjust(self) -> None:
        """Adjust what there is as a free network, with the interior orientation as an unknown."""
        for _ in range(2):
            rows = np.flatnonzero(self.used())
            if not len(rows):
                # The images of a wrong start contradict each other; nothing fits any more.
                return
            images = np.flatnonzero(self.oriented)
            points, point = np.unique(self.tracks.point[rows], return_inverse=True)
            image = np.searchsorted(images, self.tracks.image[rows])
            given = FreeBlock(
                self.station[images], self.rotation[images], self.xyz[points], self.interior
            )
            cameras = self.cameras
            if len(images) < _INTERIOR_FROM:
                cameras = tuple(replace(camera, free=frozenset()) for camera in cameras)
            found = damped_adjustment(
                cameras, self.tracks.camera_of[images], given, image, point, self.tracks.xy_mm[rows]
            )
            self.station[images], self.rotation[images] = found.station, found.rotation
            self.xyz[points], self.interior = found.points, found.interior
            self._place()
            fits = self._residual_px(self.xyz, rows)
            self.limit_px = float(
                np.clip(5.0 * np.median(fits), _RESIDUAL_MAX_PX, _FIRST_RESIDUAL_MAX_PX)
            )
            self._intersect()


def _by_common_points(tracks: PhotographTracks) -> list[list[tuple[int, int]]]:
    """Pairs of images with enough common points, those with the most first.

    By groups of connected images, the largest ones, the largest first.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    shape = (tracks.images, tracks.points)
    seen = csr_array((np.ones(len(tracks.image)), (tracks.image, tracks.point)), shape=shape)
    common = np.triu((seen @ seen.T).toarray(), 1)
    common[common < 2 * POINTS_MIN] = 0.0
    _, group = connected_components(csr_array(common), directed=False)
    largest = np.argsort(-np.bincount(group), kind="stable")[:_GROUPS_TRIED]
    a, b = np.nonzero(common)
    order = np.lexsort((b, a, -common[a, b]))
    return [[(int(a[k]), int(b[k])) for k in order if group[a[k]] == one] for one in largest]


@dataclass(frozen=True)
class _Pair:
    """Two images, and the rows of their common points in each."""

    first: int
    second: int
    first_rows: Indices
    second_rows: Indices


@dataclass(frozen=True)
class _Start:
    """A pair of images and one of its relative orientations, second from first, vision axes."""

    first: int
    second: int
    rotation: Array
    shift: Array


def _starts(
    cameras: tuple[CameraModel, ...], tracks: PhotographTracks, pair: _Pair
) -> list[_Start]:
    """Relative orientations of a pair.

    A plane is seen alike from two places by two pairs of attitudes. Which is right shows when
    further images are oriented; all are returned.
    """
    block = _Growing(cameras, tracks)
    first, second = block.ideal[pair.first_rows], block.ideal[pair.second_rows]
    limit = _RESIDUAL_MAX_PX * float(block.pixel[[pair.first, pair.second]].max())
    found = [*_by_essential(first, second, limit), *_by_plane(first, second, 2.0 * limit)]
    return [
        _Start(pair.first, pair.second, turn, shift / np.linalg.norm(shift))
        for turn, shift in found
    ]


def _by_essential(a: Array, b: Array, limit: float) -> list[tuple[Array, Array]]:
    essential, inside = cv2.findEssentialMat(
        a, b, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=limit
    )
    if essential is None or essential.shape != (3, 3) or inside is None:
        return []
    own = inside.ravel() > 0
    if own.sum() < POINTS_MIN:
        return []
    _, rotation, shift, _ = cv2.recoverPose(essential, a[own], b[own])
    return [(rotation, shift.ravel())]


def _by_plane(a: Array, b: Array, limit: float) -> list[tuple[Array, Array]]:
    """Orientations whose plane lies in front of both images."""
    homography, inside = cv2.findHomography(a, b, cv2.USAC_MAGSAC, limit)
    if homography is None or inside is None or inside.sum() < POINTS_MIN:
        return []
    rays = np.column_stack([a, np.ones(len(a))])[inside.ravel() > 0]
    _, turns, shifts, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
    return [
        (turn, shift.ravel())
        for turn, shift, normal in zip(turns, shifts, normals, strict=True)
        if np.median(rays @ normal) > 0.0 and np.linalg.norm(shift) > _SHIFT_MIN
    ]
