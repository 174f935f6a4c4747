"""Observation equations of image points: collinearity with everything that image rays depend on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError
from processing.bundle.camera_model import (
    ideal_mm,
    interior_derivatives,
    measured_by_ideal,
    principal_distance_mm,
    term_derivatives,
)
from processing.bundle.curvature_refraction import corrected_rays
from processing.bundle.equation_rows import RowBuilder, columns_where
from processing.bundle.exposure_motion import RowMotion, row_motion, time_columns
from processing.bundle.network import CameraModel, Network
from processing.bundle.unknowns import ParameterLayout, ParameterValues
from processing.geometry.rotation import skew

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ROWS_AT_ONCE = 50_000
_NEWTON_STEPS = 4
_AT_REST_MM = 1e-6
_NEAR = 0.01
"""Misclosure over principal distance below which a point is no blunder."""


class BehindCameraError(ProcessingError, ValueError):
    """Object points are behind the camera that saw them: starting values are far off."""

    def __init__(self, image_points: Indices) -> None:
        self.image_points = image_points
        super().__init__(f"{len(image_points)} image points see an object point behind the camera")


def image_rows(
    build: RowBuilder,
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    weight: Array,
) -> None:
    """Append the rows of all image points.

    Args:
        build: what they are appended to.
        network: observations.
        layout: columns.
        state: current values.
        weight: factor on the weight of each image point, shape (image points,).

    Raises:
        BehindCameraError: an object point is not in front of a camera that saw it.

    Source: docs/explanation/mathematics/bundle.md#collinearity.
    """
    measured, images = network.image_points, network.images
    part = layout.eliminated[measured.point]
    takes_part = (part >= 0) | (layout.retained_points[measured.point] >= 0).any(axis=1)
    takes_part |= layout.locked[measured.point].all(axis=1)
    behind: list[Indices] = []
    for index in range(len(network.cameras)):
        of_camera = np.flatnonzero(
            (images.camera[measured.image] == index) & (weight > 0.0) & takes_part
        )
        # In parts: what is computed on the way is larger than the rows.
        for low in range(0, len(of_camera), _ROWS_AT_ONCE):
            rows = of_camera[low : low + _ROWS_AT_ONCE]
            behind.append(_camera_rows(build, network, layout, state, weight, index, rows))
    if any(len(part) for part in behind):
        raise BehindCameraError(np.concatenate(behind))


def _camera_rows(
    build: RowBuilder,
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    weight: Array,
    index: int,
    rows: Indices,
) -> Indices:
    """Rows of image points of one camera; those whose object point is behind it, and then none."""
    measured, images, camera = network.image_points, network.images, network.cameras[index]
    part = layout.eliminated[measured.point]
    image, point = measured.image[rows], measured.point[rows]
    station, attitude, head = images.station[image], images.attitude[image], images.head[image]
    object_from_rig = state.attitude[attitude]
    place = state.station[station]
    motion = row_motion(network, state, image, measured.xy_mm[rows, 1])
    if motion is not None:
        place = place + motion.shift_m
    scale = np.where(network.points.at_infinity[point], 0.0, 1.0)
    ray = state.points[point] - scale[:, None] * place
    is_straight = network.rays.is_straight
    if not is_straight:
        ray, ray_by_point, ray_by_station = corrected_rays(ray, place[:, 2], network.rays)
    in_rig = at_exposure = np.einsum("nji,nj->ni", object_from_rig, ray)
    if motion is not None:
        in_rig = np.einsum("nji,nj->ni", motion.rotation, at_exposure)
    rig_from_camera = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
    offset = np.zeros((len(rows), 3))
    mounted = head >= 0
    rig_from_camera[mounted] = state.head_rotation[head[mounted]]
    offset[mounted] = state.head_offset[head[mounted]]
    seen = np.einsum("nji,nj->ni", rig_from_camera, in_rig - scale[:, None] * offset)
    if (seen[:, 2] >= 0.0).any():
        return np.asarray(rows[seen[:, 2] >= 0.0])
    interior = state.interior[index]
    c = principal_distance_mm(camera, interior)
    projected = -c * seen[:, :2] / seen[:, 2:]
    measured_mm = measured.xy_mm[rows]
    patterns = _pattern_design(network, image, measured_mm) if network.patterns else None
    target = projected
    if patterns is not None:
        target = projected + np.einsum("nak,nk->na", patterns, state.pattern[image])
    terms = state.terms[index]
    misclosure, adjusted_mm, to_measured = _misclosures(
        camera, interior, terms, measured_mm, target
    )
    entries: list[tuple[Indices, Array]] = []
    by_point = np.zeros((len(rows), 2, 3))
    if build.derivatives:
        by_seen = np.zeros((len(rows), 2, 3))
        by_seen[:, 0, 0] = by_seen[:, 1, 1] = -c / seen[:, 2]
        by_seen[:, :, 2] = -projected / seen[:, 2:]
        by_rig = np.einsum("nij,nkj->nik", by_seen, rig_from_camera)
        by_exposure = by_rig
        if motion is not None:
            by_exposure = np.einsum("nij,nkj->nik", by_rig, motion.rotation)
        by_point = np.einsum("nij,nkj->nik", by_exposure, object_from_rig)
        by_station = -by_point * scale[:, None, None]
        if not is_straight:
            by_point, by_station = by_point @ ray_by_point, by_point @ ray_by_station
        blocks = [
            (layout.station[station], by_station),
            (layout.attitude[attitude], by_exposure @ skew(at_exposure)),
            (layout.retained_points[point], by_point),
        ]
        if (layout.interior[index] >= 0).any():
            by_interior = -interior_derivatives(camera, interior, terms, adjusted_mm)
            if camera.model == "centred":
                by_interior[:, :, 2] = -projected / c
            elif camera.model != "australis":
                by_interior[:, :, 2] -= projected / c
            columns = np.broadcast_to(layout.interior[index], (len(rows), 10))
            blocks.append((columns, by_interior))
        if camera.terms:
            columns = np.broadcast_to(layout.terms[index], (len(rows), len(camera.terms)))
            by_term = -term_derivatives(camera, interior, terms, adjusted_mm)
            blocks += _active(columns, by_term)
        if patterns is not None:
            blocks.append((layout.pattern[image], patterns))
        if mounted.any():
            blocks += [
                (columns_where(layout.head_rotation, head), by_seen @ skew(seen)),
                (columns_where(layout.head_offset, head), -by_rig * scale[:, None, None]),
            ]
        if motion is not None:
            by_time = _by_time(motion, in_rig, by_rig, by_station)
            blocks += time_columns(layout, network, image, by_time, motion.by_readout)
        blocks = [(columns, values.reshape(len(rows), 2, -1)) for columns, values in blocks]
        if to_measured is not None:
            blocks = [(columns, to_measured @ values) for columns, values in blocks]
            by_point = to_measured @ by_point
        entries = blocks
    locked = layout.locked[point]
    for axis in range(2):
        build.add(
            misclosure[:, axis],
            measured.sigma_mm[rows, axis],
            np.full(len(rows), axis),
            rows,
            [(columns, values[:, axis]) for columns, values in entries],
            point=part[rows],
            point_part=np.where(locked | (part[rows] < 0)[:, None], 0.0, by_point[:, axis]),
            weight=weight[rows],
            axis=axis,
        )
    return rows[:0]


def _misclosures(
    camera: CameraModel, interior: Array, terms: Array, measured_mm: Array, target: Array
) -> tuple[Array, Array, Array | None]:
    """Misclosures, where derivatives are taken, and d(measured) / d(ideal) there.

    Derivatives at what was measured would share its errors with the misclosures, so they are taken
    at the adjusted image points, whose ideal coordinates are the target; with forward models to
    first order, and for blunders, where the distortion may have no inverse, at what was measured.

    Source: docs/explanation/mathematics/bundle.md#residuals.
    """
    adjusted_mm = measured_mm
    if camera.model != "australis":
        misclosure = ideal_mm(camera, interior, terms, measured_mm) - target
        to_measured = measured_by_ideal(camera, interior, measured_mm)
        if to_measured is not None:
            misclosure = np.einsum("nij,nj->ni", to_measured, misclosure)
            near = np.abs(misclosure).max(axis=1) < _NEAR * camera.f_mm
            adjusted_mm = measured_mm - np.where(near[:, None], misclosure, 0.0)
        return misclosure, adjusted_mm, to_measured
    for _ in range(_NEWTON_STEPS):
        to_measured = measured_by_ideal(camera, interior, adjusted_mm)
        assert to_measured is not None
        left = ideal_mm(camera, interior, terms, adjusted_mm) - target
        step = np.einsum("nij,nj->ni", to_measured, left)
        adjusted_mm = adjusted_mm - step
        if np.abs(step).max(initial=0.0) < _AT_REST_MM:
            break
    return measured_mm - adjusted_mm, adjusted_mm, to_measured


def _pattern_design(network: Network, image: Indices, xy_mm: Array) -> Array:
    """Displacements of image points by amplitudes of one, (n, 2, k)."""
    most = max((own.count for own in network.patterns if own is not None), default=0)
    result = np.zeros((len(image), 2, most))
    for k in np.unique(image):
        own = network.patterns[k]
        if own is not None and own.count:
            rows = image == k
            result[rows, :, : own.count] = own.at(xy_mm[rows])
    return result


def _by_time(motion: RowMotion, in_rig: Array, by_rig: Array, by_station: Array) -> Array:
    """d(projected) / d(instant of the row), (n, 2), mm/s."""
    turned = np.cross(in_rig, motion.rate_rad_per_s)
    by_rotation = np.einsum("nij,nj->ni", by_rig, turned)
    return np.asarray(by_rotation + np.einsum("nij,nj->ni", by_station, motion.velocity_mps))


def _active(columns: Indices, by_term: Array) -> list[tuple[Indices, Array]]:
    """Terms act on parts of the image: columns of -1 where an entry is zero."""
    active = (by_term != 0.0).any(axis=1)
    return [(np.where(active, columns, -1), by_term)]
