"""Starting values: images of all heads oriented one by one, then joined to one rig.

Heads whose images do not hang together with the others are oriented by themselves and placed by the
positions of their exposures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.camera_model import ideal_mm
from processing.bundle.incremental_orientation import PhotographTracks, orient_photographs
from processing.bundle.initial_values import intersect
from processing.calibration.board.network import mounting_of
from processing.calibration.flight.images import (
    FlightCalibrationError,
    FlightImages,
    camera_of,
)
from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.positions_fit import NotPlacedError, fit_positions
from processing.rig import Cone

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

_ORIENTED_MIN: Final = 4
_COMMON_MIN: Final = 3
_PARALLAX_MIN_RAD: Final = np.radians(1.0)
_RESIDUAL_MIN_PX: Final = 4.0
_RESIDUAL_MAX_PX: Final = 60.0
_PASSES: Final = 3
_BENT_SHARE: Final = 0.1
"""Residual of positions over their spread above which a block is broken, not bent."""


@dataclass(frozen=True)
class FlightStart:
    """Where rig, heads and points are, about.

    Attributes:
        reference: index of the reference head.
        heads: indices of the heads that are oriented, the reference first.
        station_m, rotation: (exposures, 3), (exposures, 3, 3) of the reference head, NaN where not
            known.
        mounting: reference_from_head (3, 3) and offset (3,) m, by head.
        xyz_m: (points, 3), NaN where not known.
        used: (image points,) that fit.
        left_out: a sentence on each head that is not oriented.
    """

    reference: int
    heads: tuple[int, ...]
    station_m: Array
    rotation: Array
    mounting: dict[int, tuple[Array, Array]]
    xyz_m: Array
    used: Flags
    left_out: tuple[str, ...]


@dataclass
class _Oriented:
    """Images (n, 3), (n, 3, 3) and rays (image points, 3) in camera axes; NaN where not known."""

    station_m: Array
    rotation: Array
    ray: Array
    pixel: Array

    def of_head(self, images: FlightImages, head: int) -> tuple[Array, Array]:
        """Poses of a head by exposure, (e, 3) and (e, 3, 3)."""
        count = len(images.position_m)
        station, rotation = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
        own = np.flatnonzero(images.head == head)
        station[images.exposure[own]] = self.station_m[own]
        rotation[images.exposure[own]] = self.rotation[own]
        return station, rotation


def image_points_mm(cones: Sequence[Cone], images: FlightImages) -> Array:
    """Image coordinates of all tracks about each head's principal point.

    Args:
        cones: heads, one sensor each.
        images: tracks in pixels.

    Returns:
        Shape (image points, 2), mm, y up.
    """
    found = np.zeros_like(images.tracks.px)
    head = images.head[images.tracks.image]
    for k, cone in enumerate(cones):
        own = head == k
        found[own] = layer_mm_from_raw(cone.sensors[0], images.tracks.px[own])
    return found


def start_of(
    cones: Sequence[Cone],
    images: FlightImages,
    reference: int,
    *,
    progress: Callable[[str, int, int], None],
) -> FlightStart:
    """Orient every head alone, then average their mountings and intersect the points.

    Args:
        cones: heads as `processing.calibration.board.network.started` returns them.
        images: of all heads.
        reference: index of the head that the others are oriented against.
        progress: called with what is done, and counts.

    Returns:
        Starting values.

    Raises:
        FlightCalibrationError: the reference head cannot be oriented.
    """
    found = _orient_images(cones, images, reference, progress)
    base_rotation = found.of_head(images, reference)[1]
    mounting = {reference: (np.eye(3), np.zeros(3))}
    left_out: list[str] = []
    for k, cone in enumerate(cones):
        if k == reference:
            continue
        rotation = found.of_head(images, k)[1]
        common = np.isfinite(rotation[:, 0, 0]) & np.isfinite(base_rotation[:, 0, 0])
        if common.sum() < _COMMON_MIN:
            left_out.append(
                f"{cone.name}: {int(np.isfinite(rotation[:, 0, 0]).sum())} images are oriented, "
                f"{common.sum()} of them at an exposure of {cones[reference].name} that is; "
                f"{_COMMON_MIN} are needed. Its lens and its orientation are as they were"
            )
            continue
        relative = np.einsum("nji,njk->nik", base_rotation[common], rotation[common])
        mounting[k] = (_mean_rotation(relative), mounting_of(cone, cones[reference])[1])
    heads = (reference, *(k for k in mounting if k != reference))
    station, rotation = _rig_poses(images, found, mounting, heads)
    xyz, used = _points(images, found, mounting, (station, rotation))
    return FlightStart(reference, heads, station, rotation, mounting, xyz, used, tuple(left_out))


def _orient_images(
    cones: Sequence[Cone],
    images: FlightImages,
    reference: int,
    progress: Callable[[str, int, int], None],
) -> _Oriented:
    """All images together; heads that this does not reach by themselves."""
    count, rows = len(images.head), len(images.tracks.image)
    found = _Oriented(
        np.full((count, 3), np.nan),
        np.full((count, 3, 3), np.nan),
        np.full((rows, 3), np.nan),
        np.ones(rows),
    )
    xy_mm = image_points_mm(cones, images)
    everyone = tuple(range(len(cones)))
    problems: list[str] = []
    for heads in dict.fromkeys((everyone, (reference,), *((k,) for k in everyone))):
        own = np.isin(images.head, heads)
        oriented = np.isfinite(found.station_m[:, 0])
        if all((oriented & (images.head == k)).sum() >= _ORIENTED_MIN for k in heads):
            continue
        progress(f"orienting {', '.join(cones[k].name for k in heads)}", 0, 0)
        base = reference if reference in heads else heads[0]
        try:
            _orient_together(cones, images, xy_mm, np.flatnonzero(own), base, found)
        except FlightCalibrationError as error:
            problems.append(str(error))
    if not np.isfinite(found.station_m[images.head == reference, 0]).any():
        raise FlightCalibrationError(problems[-1] if len(cones) == 1 else problems[0])
    return found


def _orient_together(
    cones: Sequence[Cone],
    images: FlightImages,
    xy_mm: Array,
    own: Indices,
    base: int,
    found: _Oriented,
) -> None:
    """Orient images as if one camera had taken them: coordinates are scaled to one distance."""
    names = ", ".join(cones[k].name for k in np.unique(images.head[own]))
    number = np.full(len(images.head), -1)
    number[own] = np.arange(len(own))
    rows = np.flatnonzero(number[images.tracks.image] >= 0)
    camera = camera_of(cones[base], is_centred=False)
    distance = np.array([cone.lens.f_mm for cone in cones])[images.head[images.tracks.image[rows]]]
    scaled = xy_mm[rows] * (camera.f_mm / distance)[:, None]
    block = orient_photographs(
        (camera,),
        PhotographTracks(
            number[images.tracks.image[rows]],
            images.tracks.point[rows],
            scaled,
            len(own),
            images.tracks.points,
        ),
    )
    oriented = 0 if block is None else int(block.oriented.sum())
    if block is None or oriented < _ORIENTED_MIN:
        raise FlightCalibrationError(
            f"{names}: {oriented} of {len(own)} images hang together; {_ORIENTED_MIN} are needed, "
            "over textured ground, with 60 % of overlap along the line"
        )
    position = images.position_m[images.exposure[own]]
    placed = block.oriented & np.isfinite(position[:, 0])
    try:
        fit = fit_positions(block.station[placed], position[placed])
    except NotPlacedError as error:
        raise FlightCalibrationError(f"{names}: {error}") from error
    size = np.linalg.norm(position[placed].std(axis=0))
    away = np.sqrt(np.mean(np.sum(fit.residual_m**2, axis=1)))
    if away > _BENT_SHARE * size:
        raise FlightCalibrationError(
            f"{names}: images and positions contradict each other by {away:.1f} m. Lines that "
            "hardly overlap do not hang together, the ground repeats itself, or times of positions "
            "and frames do not match"
        )
    new = own[block.oriented]
    found.station_m[new] = fit.applied(block.station[block.oriented])
    found.rotation[new] = fit.rotation @ block.rotation[block.oriented]
    ideal = ideal_mm(camera, block.interior[0], np.zeros(0), scaled)
    found.ray[rows] = np.column_stack([ideal, np.full(len(rows), -camera.f_mm)])
    found.pixel[rows] = (camera.pixel_mm or 1e-3) / camera.f_mm


def _mean_rotation(rotations: Array) -> Array:
    """The rotation nearest to the median of all, (3, 3)."""
    u, _, vt = np.linalg.svd(np.median(rotations, axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _rig_poses(
    images: FlightImages,
    found: _Oriented,
    mounting: dict[int, tuple[Array, Array]],
    heads: tuple[int, ...],
) -> tuple[Array, Array]:
    """Poses of the reference head, from another head where it is not oriented itself."""
    count = len(images.position_m)
    station, rotation = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    for k in heads:
        turn, offset = mounting[k]
        own_station, own_rotation = found.of_head(images, k)
        new = np.isnan(station[:, 0]) & np.isfinite(own_station[:, 0])
        rotation[new] = own_rotation[new] @ turn.T
        station[new] = own_station[new] - rotation[new] @ offset
    return station, rotation


def _points(
    images: FlightImages,
    found: _Oriented,
    mounting: dict[int, tuple[Array, Array]],
    poses: tuple[Array, Array],
) -> tuple[Array, Flags]:
    """Object points, (points, 3), and the image points that fit them."""
    tracks = images.tracks
    head, exposure = images.head[tracks.image], images.exposure[tracks.image]
    start = np.full((len(head), 3), np.nan)
    turned = np.full((len(head), 3, 3), np.nan)
    for k, (turn, offset) in mounting.items():
        own = np.flatnonzero(head == k)
        turned[own] = poses[1][exposure[own]] @ turn
        start[own] = poses[0][exposure[own]] + poses[1][exposure[own]] @ offset
    ray, pixel = found.ray, found.pixel
    direction = np.einsum("nij,nj->ni", turned, ray)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    used = np.isfinite(direction).all(axis=1) & np.isfinite(start).all(axis=1)
    xyz = np.full((tracks.points, 3), np.nan)
    for _ in range(_PASSES):
        rows = np.flatnonzero(used)
        xyz, _ = intersect(tracks.points, tracks.point[rows], start[rows], direction[rows])
        away = xyz[tracks.point[rows]] - start[rows]
        off = np.linalg.norm(np.cross(away, direction[rows]), axis=1)
        with np.errstate(all="ignore"):
            residual = off / np.linalg.norm(away, axis=1) / pixel[rows]
        typical = float(np.nanmedian(residual)) if len(rows) else 0.0
        limit = min(max(5.0 * typical, _RESIDUAL_MIN_PX), _RESIDUAL_MAX_PX)
        used[rows] = residual < limit
        count = np.bincount(tracks.point[used], minlength=tracks.points)
        used &= count[tracks.point] >= 2
    rows = np.flatnonzero(used)
    wide = _parallax(tracks.point[rows], direction[rows], tracks.points) > _PARALLAX_MIN_RAD
    used &= wide[tracks.point]
    return xyz, used


def _parallax(point: Indices, direction: Array, points: int) -> Array:
    """The largest angle of the rays of each point against their mean, doubled, rad."""
    mean = np.zeros((points, 3))
    np.add.at(mean, point, direction)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    angle = np.arccos(np.clip(np.einsum("ni,ni->n", direction, mean[point]), -1.0, 1.0))
    largest = np.zeros(points)
    np.maximum.at(largest, point, angle)
    return 2.0 * largest
