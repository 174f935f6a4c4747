"""A fast adjustment of images as a free network, for starting values.

Damped least squares with robust weights: damping stands in for a datum. It yields values, no
statistics; `processing.bundle.adjust` is the adjustment that results are taken from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.camera_model import ideal_mm, interior_derivatives
from processing.bundle.network import INTERIOR, CameraModel
from processing.geometry.rotation import rotations_from_vectors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ROUNDS: Final = 40
_HUBER_PX: Final = 2.0
_CONVERGED: Final = 1e-5
_DAMPING: Final = 1e-4
_DAMPING_MAX: Final = 1e8
_NO_SIGMA: Final = 1e9
_INTERIOR_MAX: Final = 5.0
"""Largest change of a parameter over its standard deviation. Without it a principal distance of
zero explains all image points, since residuals are measured in the plane of the ideal ones."""


@dataclass(frozen=True)
class FreeBlock:
    """Unknowns: station (n, 3), rotation (n, 3, 3) object from camera, points (p, 3).

    `interior` holds the ten of each camera, (cameras, 10).
    """

    station: Array
    rotation: Array
    points: Array
    interior: Array


def damped_adjustment(
    cameras: Sequence[CameraModel],
    camera_of: Indices,
    block: FreeBlock,
    image: Indices,
    point: Indices,
    xy_mm: Array,
) -> FreeBlock:
    """Least squares of image points, with robust weights, from values nearby.

    Args:
        cameras: their `free` parameters, the same of all, are estimated, each with its `sigma`
            about the camera's own values; the model is eq. 5.1 of Heier et al. (2002).
        camera_of: camera of each image, shape (n,).
        block: values to begin with.
        image: image of each image point, shape (m,).
        point: object point of each, shape (m,).
        xy_mm: measured, shape (m, 2), mm.

    Returns:
        Adjusted values; the datum is about that of the given ones.

    Source: docs/explanation/mathematics/bundle.md#orientation-without-attitudes.
    """
    free = [k for k, name in enumerate(INTERIOR) if name in cameras[0].free]
    problem = _Problem(tuple(cameras), free, image, camera_of[image], point, xy_mm)
    misclosure = problem.misclosure(block)
    cost = problem.cost(misclosure, block)
    damping = _DAMPING
    for _ in range(_ROUNDS):
        equations = problem.equations(block, misclosure)
        while True:
            trial = problem.moved(block, equations.solve(damping))
            after = problem.misclosure(trial)
            better = problem.cost(after, trial)
            if better < cost:
                break
            damping *= 10.0
            if damping > _DAMPING_MAX:
                return block
        gain = (cost - better) / cost
        block, misclosure, cost = trial, after, better
        damping = max(damping * 0.1, 1e-12)
        if gain < _CONVERGED:
            break
    return block


@dataclass(frozen=True)
class _Reduced:
    """Normal equations with the object points eliminated, unknowns scaled to unit diagonal."""

    normal: Array
    right: Array
    coupling: Any
    points: Array
    points_right: Array
    columns: int

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Corrections of images and interior orientation (c,), and of points (p, 3)."""
        own = self.points * (1.0 + damping * np.eye(3))
        inverse = np.asarray(np.linalg.inv(own), np.float64)
        block = _block_diagonal(inverse)
        coupled = self.coupling @ block
        normal = self.normal * (1.0 + damping * np.eye(self.columns))
        reduced = normal - (coupled @ self.coupling.T).toarray()
        right = self.right - coupled @ self.points_right.ravel()
        solution = np.linalg.lstsq(reduced, right, rcond=1e-15)[0]
        back = self.points_right.ravel() - self.coupling.T @ solution
        return solution, np.einsum("pij,pj->pi", inverse, back.reshape(-1, 3))


@dataclass(frozen=True)
class _Problem:
    cameras: tuple[CameraModel, ...]
    free: list[int]
    image: Indices
    camera: Indices
    point: Indices
    xy_mm: Array

    @cached_property
    def sigma_mm(self) -> Array:
        """Of each image point, (m,)."""
        return np.array([one.pixel_mm or 1e-3 for one in self.cameras])[self.camera]

    @cached_property
    def f_mm(self) -> Array:
        """Of the camera of each image point, (m,)."""
        return np.array([one.f_mm for one in self.cameras])[self.camera]

    @cached_property
    def rows(self) -> list[Indices]:
        """Image points of each camera."""
        return [np.flatnonzero(self.camera == k) for k in range(len(self.cameras))]

    @cached_property
    def prior(self) -> Array:
        """Standard deviations of the free parameters, (cameras, f)."""
        return np.array(
            [[one.sigma.get(INTERIOR[k], _NO_SIGMA) for k in self.free] for one in self.cameras]
        )

    def change(self, block: FreeBlock) -> Array:
        """Free parameters less those of the cameras, (cameras, f)."""
        given = np.array([one.interior for one in self.cameras])
        return np.asarray((block.interior - given)[:, self.free])

    def misclosure(self, block: FreeBlock) -> Array:
        """Ideal image coordinates less the projection of object points, (m, 2), mm."""
        ideal = np.empty_like(self.xy_mm)
        for camera, interior, rows in zip(self.cameras, block.interior, self.rows, strict=True):
            terms = np.zeros(len(camera.terms))
            ideal[rows] = ideal_mm(camera, interior, terms, self.xy_mm[rows])
        seen = self.seen(block)
        with np.errstate(all="ignore"):
            place = -self.f_mm[:, None] * seen[:, :2] / seen[:, 2:]
        place[seen[:, 2] >= 0.0] = 1e6
        return np.asarray(ideal - place)

    def seen(self, block: FreeBlock) -> Array:
        """Object points in camera axes, (m, 3)."""
        away = block.points[self.point] - block.station[self.image]
        return np.asarray(np.einsum("mji,mj->mi", block.rotation[self.image], away))

    def weights(self, misclosure: Array) -> Array:
        size = np.linalg.norm(misclosure, axis=1) / self.sigma_mm
        return np.asarray(np.minimum(1.0, _HUBER_PX / np.maximum(size, 1e-12)))

    def cost(self, misclosure: Array, block: FreeBlock) -> float:
        size = np.linalg.norm(misclosure, axis=1) / self.sigma_mm
        huber = np.where(size <= _HUBER_PX, size**2, 2.0 * _HUBER_PX * size - _HUBER_PX**2)
        change = self.change(block) / self.prior
        if (np.abs(change) > _INTERIOR_MAX).any():
            return np.inf
        return float(huber.sum() + (change**2).sum())

    def equations(self, block: FreeBlock, misclosure: Array) -> _Reduced:
        from scipy.sparse import csr_array

        m, images = len(self.image), len(block.station)
        seen = self.seen(block)
        f = self.f_mm
        by_seen = np.zeros((m, 2, 3))
        by_seen[:, 0, 0] = by_seen[:, 1, 1] = -f / seen[:, 2]
        by_seen[:, 0, 2] = f * seen[:, 0] / seen[:, 2] ** 2
        by_seen[:, 1, 2] = f * seen[:, 1] / seen[:, 2] ** 2
        by_point = by_seen @ block.rotation[self.image].transpose(0, 2, 1)
        # R becomes R exp(w): what is seen turns by -w x seen.
        cross = np.zeros((m, 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -seen[:, 2], seen[:, 1], -seen[:, 0]
        cross -= cross.transpose(0, 2, 1)
        by_rotation = by_seen @ cross
        by_interior = np.zeros((m, 2, len(self.free)))
        for camera, interior, rows in zip(self.cameras, block.interior, self.rows, strict=True):
            terms = np.zeros(len(camera.terms))
            derivatives = interior_derivatives(camera, interior, terms, self.xy_mm[rows])
            by_interior[rows] = -derivatives[:, :, self.free]
        root = (np.sqrt(self.weights(misclosure)) / self.sigma_mm)[:, None]
        design = np.concatenate([-by_point, by_rotation, by_interior], axis=2) * root[:, :, None]
        of_point = by_point * root[:, :, None]
        right = misclosure * root
        columns = 6 * images + self.prior.size
        own = np.concatenate(
            [
                6 * self.image[:, None] + np.arange(6),
                6 * images + len(self.free) * self.camera[:, None] + np.arange(len(self.free)),
            ],
            axis=1,
        )
        a = csr_array(
            (
                design.reshape(2 * m, -1).ravel(),
                np.repeat(own, 2, axis=0).ravel(),
                np.arange(2 * m + 1) * own.shape[1],
            ),
            shape=(2 * m, columns),
        )
        b = csr_array(
            (
                of_point.reshape(-1),
                np.repeat(3 * self.point[:, None] + np.arange(3), 2, axis=0).ravel(),
                np.arange(2 * m + 1) * 3,
            ),
            shape=(2 * m, 3 * len(block.points)),
        )
        normal = (a.T @ a).toarray()
        size = np.arange(6 * images, columns)
        normal[size, size] += 1.0 / self.prior.ravel() ** 2
        rhs = a.T @ right.ravel()
        rhs[6 * images :] -= (self.change(block) / self.prior**2).ravel()
        points = np.zeros((len(block.points), 3, 3))
        np.add.at(points, self.point, np.einsum("mki,mkj->mij", of_point, of_point))
        points += 1e-12 * np.trace(points, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        return _Reduced(
            normal, rhs, (a.T @ b).tocsr(), points, (b.T @ right.ravel()).reshape(-1, 3), columns
        )

    def moved(self, block: FreeBlock, by: tuple[Array, Array]) -> FreeBlock:
        poses = by[0][: 6 * len(block.station)].reshape(-1, 6)
        interior = block.interior.copy()
        interior[:, self.free] += by[0][6 * len(block.station) :].reshape(self.prior.shape)
        return FreeBlock(
            block.station + poses[:, :3],
            block.rotation @ rotations_from_vectors(poses[:, 3:]),
            block.points + by[1],
            interior,
        )


def _block_diagonal(blocks: Array) -> Any:
    from scipy.sparse import bsr_array

    n = len(blocks)
    return bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n)).tocsr()
