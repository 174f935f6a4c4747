"""Triangulation while images arrive: a window after each, the whole block at the end of each line.

Images come with measured orientations; each leaves an adjusted one with its covariance. What a
flight or a replay reads and writes is in `daemon.onboard.triangulation`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.bundle.block_adjustment import (
    BlockAdjustment,
    TieObservations,
    adjust_images,
    intersected,
)
from processing.bundle.flown_network import MeasuredOrientations, MountingPrior
from processing.geometry.rotation import rotations_from_vectors
from processing.matching.block_matching import image_mm
from processing.matching.growing_block import GrowingBlock, GrowingSettings, ImageTies
from processing.matching.patch_tracks import Picture
from processing.rig import VirtualImage

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Source = Literal["measured", "window", "block"]

_FACTOR_RANGE: Final = (0.25, 9.0)
_FACTOR_CHANGED: Final = 0.3
"""A variance factor that differs more from one repeats the adjustment with the new weights."""
_WEIGHT_ROUNDS: Final = 3
_WINDOW_ROUNDS: Final = 2
_BLOCK_ROUNDS: Final = 8
_MIN_RAYS: Final = 2
_FLOOR_SIGMA_PX: Final = 0.02
"""Relief within a patch displaces its matches by about this much, alike in neighbouring images."""


@dataclass(frozen=True)
class LiveSettings:
    """How a flight is triangulated.

    Attributes:
        growing: features and matching.
        prior: of boresight and lever arm.
        window: images of the current line that are adjusted with each new one.
        neighbours: images of earlier lines that take part, those with most common points.
        points_per_image: that are adjusted; the ones with most rays.
        images_max: latest images that are adjusted as one block; bounds time and memory.
        image_sigma_px: of an image coordinate, to begin with.
    """

    growing: GrowingSettings = field(default_factory=GrowingSettings)
    prior: MountingPrior = field(default_factory=MountingPrior)
    window: int = 6
    neighbours: int = 6
    points_per_image: int = 40
    images_max: int = 600
    image_sigma_px: float = 0.03


@dataclass(frozen=True)
class MeasuredImage:
    """One image with its measured orientation.

    Attributes:
        number: of the exposure.
        line: name of the flight line.
        time_s: since any fixed instant.
        position_m, rotation: (3,), (3, 3) projection centre and object from camera, Cartesian
            frame with z up.
        position_sigma_m, attitude_sigma_rad: (3,), the latter about the camera's axes.
        velocity_mps: (3,) in the same frame, NaN if unknown.
        temperature_c: of the camera, NaN if unknown.
    """

    number: int
    line: str
    time_s: float
    position_m: Array
    rotation: Array
    position_sigma_m: Array
    attitude_sigma_rad: Array
    velocity_mps: Array
    temperature_c: float = math.nan


@dataclass(frozen=True)
class LiveOrientation:
    """Adjusted orientation of an image.

    Attributes:
        covariance: (6, 6) of the projection centre (m) and of the rotation vector about the
            camera's axes (rad).
        source: `measured`: nothing ties the image; `window`: adjusted with its neighbours, `block`:
            with the block.
        ties: points that other images see too.
    """

    image: MeasuredImage
    position_m: Array
    rotation: Array
    covariance: Array
    source: Source
    ties: int


class LiveTriangulation:
    """The block of a flight so far.

    Args:
        image: geometry of the images.
        ground_m: height of the ground to begin with.
        settings: sizes and priors.

    Attributes:
        images: as measured, in the order they came.
        orientations: by image.
        ties: what each image added.
        last: the last adjustment of the block; None before the first.
        last_images: which images it holds.
        problems: sentences of adjustments that failed since the last one of the block.
    """

    def __init__(
        self, image: VirtualImage, ground_m: float, settings: LiveSettings | None = None
    ) -> None:
        self.settings = settings or LiveSettings()
        self.image = image
        self.block = GrowingBlock(image, ground_m, self.settings.growing)
        self.images: list[MeasuredImage] = []
        self.orientations: list[LiveOrientation] = []
        self.ties: list[ImageTies] = []
        self.last: BlockAdjustment | None = None
        self.last_images: Indices = np.zeros(0, dtype=np.int64)
        self.problems: list[str] = []
        self._sigma_px = np.full(2, self.settings.image_sigma_px)

    @property
    def image_sigma_px(self) -> Array:
        """Standard deviations of image columns and rows, as residuals show them, (2,)."""
        return self._sigma_px.copy()

    def add(self, image: MeasuredImage, picture: Picture) -> LiveOrientation:
        """Tie an image to the block and adjust the window around it.

        Args:
            image: its measured orientation.
            picture: (h, w), NaN without data.

        Returns:
            Its orientation. Those of the window's other images change, too (`orientations`).

        Raises:
            ValueError: a picture of another size, or a number that came before.
        """
        if any(image.number == one.number for one in self.images):
            raise ValueError(f"image {image.number} came twice; each is triangulated once")
        station, rotation = self._predicted(image)
        self.ties.append(self.block.add(picture, station, rotation, image.line))
        self.images.append(image)
        self.orientations.append(_unadjusted(image, station, rotation))
        window = self._window()
        if len(window) > 1:
            self._adjust(window, "window")
        return self.orientations[-1]

    def adjust_block(self) -> BlockAdjustment | None:
        """Adjust the latest `images_max` images at once.

        Returns:
            The adjustment; None if it failed (`problems`) or if there are fewer than two images.
        """
        count = len(self.images)
        own = np.arange(max(0, count - self.settings.images_max), count)
        if len(own) < 2:
            return None
        done = self._adjust(own, "block")
        if done is None:
            return None
        for _ in range(_WEIGHT_ROUNDS):
            factor = np.clip(done.image_factors, *_FACTOR_RANGE)
            if (np.abs(factor - 1.0) < _FACTOR_CHANGED).all():
                break
            self._sigma_px = np.maximum(self._sigma_px * np.sqrt(factor), _FLOOR_SIGMA_PX)
            done = self._adjust(own, "block") or done
        self.last, self.last_images = done, own
        self.problems.clear()
        return done

    def tied_points(self) -> tuple[Indices, Array, Array]:
        """Points of the last adjustment of the block.

        Returns:
            Numbers (p,), coordinates (p, 3) and standard deviations (p, 3), m.
        """
        if self.last is None:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3))
        good = np.isfinite(self.last.xyz_sigma_m).all(axis=1)
        return self.last.points[good], self.last.xyz_m[good], self.last.xyz_sigma_m[good]

    def _predicted(self, image: MeasuredImage) -> tuple[Array, Array]:
        """Measured orientation with the mounting as the block shows it."""
        if self.last is None or self.last.mounting is None:
            return image.position_m, image.rotation
        found = self.last.mounting.correction
        turn = rotations_from_vectors(found[None, :3])[0]
        return image.position_m + image.rotation @ found[3:], image.rotation @ turn

    def _window(self) -> Indices:
        """The latest images of the current line, and those of other lines tied best to them."""
        line = self.images[-1].line
        own: list[int] = []
        for k in range(len(self.images) - 1, -1, -1):
            if self.images[k].line != line or len(own) >= self.settings.window:
                break
            own.append(k)
        points = np.concatenate([self.block.observed[k][0] for k in own])
        candidates = []
        for k, one in enumerate(self.orientations):
            if one.source == "block" and k not in own and self._is_near(k):
                shared = int(np.isin(self.block.observed[k][0], points).sum())
                if shared >= _MIN_RAYS:
                    candidates.append((-shared, k))
        chosen = [k for _, k in sorted(candidates)[: self.settings.neighbours]]
        return np.array(sorted(own + chosen), dtype=np.int64)

    def _is_near(self, k: int) -> bool:
        """Whether an image may overlap the last one: twice its diagonal on the ground."""
        here, there = self.orientations[-1], self.orientations[k]
        diagonal_px = float(np.hypot(self.image.width_px, self.image.height_px))
        above = float(here.position_m[2] - self.block.ground_m)
        reach = 2.0 * diagonal_px * self.image.pitch_mm / self.image.f_mm * above
        return bool(np.hypot(*(there.position_m - here.position_m)[:2]) < reach)

    def _observations(self, own: Indices) -> TieObservations:
        """Image points of points with two or more rays, the best of each image."""
        image = np.concatenate(
            [np.full(len(self.block.observed[k][0]), at) for at, k in enumerate(own)]
        )
        point = np.concatenate([self.block.observed[k][0] for k in own])
        px = np.concatenate([self.block.observed[k][1] for k in own])
        rays = np.bincount(point, minlength=self.block.points)
        tied = rays[point] >= _MIN_RAYS
        image, point, px = image[tied], point[tied], px[tied]
        order = np.lexsort((point, -rays[point], image))
        rank = np.arange(len(order)) - np.searchsorted(image[order], image[order], side="left")
        best = np.zeros(self.block.points, dtype=bool)
        best[point[order[rank < self.settings.points_per_image]]] = True
        keep = best[point]
        return TieObservations(
            image[keep].astype(np.int64),
            point[keep],
            image_mm(self.image, px[keep]),
            (self._sigma_px[0] * self.image.pitch_mm, self._sigma_px[1] * self.image.pitch_mm),
        )

    def _measured(self, own: Indices) -> MeasuredOrientations:
        """Orientations as measured, also of images that were adjusted before: adjusted ones share
        errors that their own covariances do not contain."""
        images = [self.images[k] for k in own]
        return MeasuredOrientations(
            np.array([one.position_m for one in images]),
            np.array([one.rotation for one in images]),
            np.array([one.position_sigma_m for one in images]),
            np.array([one.attitude_sigma_rad for one in images]),
        )

    def _adjust(self, own: Indices, source: Source) -> BlockAdjustment | None:
        ties = self._observations(own)
        if not len(ties.image):
            return None
        start = (
            np.array([self.orientations[k].position_m for k in own]),
            np.array([self.orientations[k].rotation for k in own]),
        )
        xyz = self.block.xyz_m.copy()
        found = intersected(self.image.f_mm, *start, ties, self.block.points)
        good = np.isfinite(found).all(axis=1) & (found[:, 2] < start[0][:, 2].min())
        xyz[good] = found[good]
        seen = good[ties.point]
        ties = replace(ties, image=ties.image[seen], point=ties.point[seen], xy_mm=ties.xy_mm[seen])
        if not len(ties.image):
            return None
        prior = self.settings.prior
        measured = self._measured(own)
        try:
            done = adjust_images(
                self.image.f_mm, measured, ties, xyz, prior, start=start,
                rounds=_BLOCK_ROUNDS if source == "block" else _WINDOW_ROUNDS,
            )  # fmt: skip
        except ProcessingError as error:
            self.problems.append(f"image {self.images[-1].number}, {source}: {error}")
            return None
        self._put(own, source, done, ties)
        return done

    def _put(
        self, own: Indices, source: Source, done: BlockAdjustment, ties: TieObservations
    ) -> None:
        used = ~done.rejected
        count = np.bincount(ties.image[used], minlength=len(own))
        covariances = done.cameras.covariances()
        for at, k in enumerate(own):
            before = self.orientations[k]
            if source == "window" and before.source == "block":
                continue  # the block is the better result, and its covariance is whole
            self.orientations[k] = LiveOrientation(
                before.image,
                done.cameras.station_m[at],
                done.cameras.rotation[at],
                covariances[at],
                source if count[at] else "measured",
                int(count[at]),
            )
        self.block.put(
            own.tolist(),
            np.array([self.orientations[k].position_m for k in own]),
            np.array([self.orientations[k].rotation for k in own]),
        )
        good = np.isfinite(done.xyz_sigma_m).all(axis=1)
        self.block.put_points(done.points[good], done.xyz_m[good])
        for at in np.unique(ties.image[done.rejected]).tolist():
            lost = ties.point[done.rejected & (ties.image == at)]
            self.block.reject(int(own[at]), lost)


def _unadjusted(image: MeasuredImage, station: Array, rotation: Array) -> LiveOrientation:
    sigma = np.concatenate([image.position_sigma_m, image.attitude_sigma_rad])
    return LiveOrientation(image, station, rotation, np.diag(sigma**2), "measured", 0)
