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
    adjust_as_after_landing,
    adjust_images,
    intersected,
    sigma_by_residuals,
)
from processing.bundle.flown_network import MeasuredOrientations, MountingPrior
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.residual_weights import TIE_SIGMA_PX
from processing.geometry.rotation import rotations_from_vectors
from processing.matching.block_matching import image_mm
from processing.matching.growing_block import GrowingBlock, GrowingSettings, ImageTies
from processing.matching.patch_tracks import Picture
from processing.rig import VirtualImage

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Source = Literal["measured", "window", "block"]
Kind = Literal["window", "block", "landing"]

_FEW_IMAGES: Final = 100
"""Of fewer images the weights are estimated in each adjustment of the block."""
_WINDOW_ROUNDS: Final = 2
_BLOCK_ROUNDS: Final = 8
_MIN_RAYS: Final = 2
_ORIENTATION: Final = 6
"""Unknowns of an image."""
_FLOOR_SIGMA_PX: Final = 0.02
"""Least sigma in flight. Relief within a patch displaces its matches by about this much, alike in
neighbouring images; a block that grows has few of them."""


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
        unknowns_max: with patterns of stitching; of a larger block fewer of them, those of each
            image that hold most of its variance.
        image_sigma_px: of an image coordinate, to begin with.
    """

    growing: GrowingSettings = field(default_factory=GrowingSettings)
    prior: MountingPrior = field(default_factory=MountingPrior)
    window: int = 6
    neighbours: int = 6
    points_per_image: int = 40
    images_max: int = 600
    unknowns_max: int = 3600
    image_sigma_px: float = TIE_SIGMA_PX


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
        patterns: what stitching may have left in it; None if that is not known.
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
    patterns: FramePatterns | None = None


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
        self._weighted_by = 0

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
        return self._adjust_latest("block")

    def land(self) -> BlockAdjustment | None:
        """Adjust the latest `images_max` images as the triangulation after landing does.

        Returns:
            The adjustment, that of `adjust_block` if this one fails (`problems`); None as there.
        """
        before = len(self.problems)
        done = self._adjust_latest("landing")
        if done is None:
            failed = self.problems[before:]
            done = self.adjust_block()
            self.problems += [one for one in failed if one not in self.problems]
        return done

    def _adjust_latest(self, kind: Kind) -> BlockAdjustment | None:
        count = len(self.images)
        own = np.arange(max(0, count - self.settings.images_max), count)
        if len(own) < 2:
            return None
        done = self._adjust(own, kind)
        if done is not None:
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
            (self.settings.image_sigma_px * self.image.pitch_mm,) * 2,
        )

    def _weights_are_old(self, images: int) -> bool:
        """Whether the sigmas of image coordinates follow from few of the block's images."""
        return images < _FEW_IMAGES or images >= 2 * self._weighted_by

    def _sigma_mm(self, kind: Kind) -> tuple[float, float]:
        floor = 0.0 if kind == "landing" else _FLOOR_SIGMA_PX
        x, y = np.maximum(self._sigma_px, floor) * self.image.pitch_mm
        return float(x), float(y)

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

    def _patterns(self, own: Indices) -> list[FramePatterns | None]:
        """Patterns of stitching of images, as many of each as the block may have.

        They are in the order of their variance.
        """
        most = max(self.settings.unknowns_max // len(own) - _ORIENTATION, 0)
        result: list[FramePatterns | None] = []
        for one in (self.images[k].patterns for k in own):
            if one is not None and one.count > most:
                one = replace(one, coefficients=one.coefficients[:most])
            result.append(one if one is not None and one.count else None)
        return result

    def _adjust(self, own: Indices, kind: Kind) -> BlockAdjustment | None:
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
        measured, f_mm, prior = self._measured(own), self.image.f_mm, self.settings.prior
        patterns = self._patterns(own) if kind != "window" else []
        try:
            if kind != "window" and self._weights_are_old(len(own)):
                sigma_mm = sigma_by_residuals(
                    f_mm, measured, ties, xyz, prior, start=start, patterns=patterns
                )
                self._sigma_px = np.array(sigma_mm) / self.image.pitch_mm
                self._weighted_by = len(own)
            ties = replace(ties, sigma_mm=self._sigma_mm(kind))
            given = (f_mm, measured, ties, xyz, prior)
            if kind == "landing":
                done = adjust_as_after_landing(*given, start=start, patterns=patterns)
            else:
                rounds = _BLOCK_ROUNDS if kind == "block" else _WINDOW_ROUNDS
                done = adjust_images(*given, start=start, rounds=rounds, patterns=patterns)
        except ProcessingError as error:
            self.problems.append(f"image {self.images[-1].number}, {kind}: {error}")
            return None
        self._put(own, "window" if kind == "window" else "block", done, ties)
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
