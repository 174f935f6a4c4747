"""Relative orientation of the heads of a rig, from a block in which every image was oriented.

Every image's rotation is taken relative to the reference image of the same exposure, and averaged
over the block with the full covariance of the adjustment.

Source: docs/explanation/mathematics/boresight.md#relative-orientation-of-heads; Jacobsen (2008),
table 2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment
from processing.geometry.rotation import (
    angles_by_rotation_vector,
    phi_omega_kappa,
    rotations_from_vectors,
    vectors_from_rotations,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ITERATIONS = 10
_CONVERGED_RAD = 1e-12


@dataclass(frozen=True)
class RelativeOrientation:
    """One head against the reference head.

    `rotation` (3, 3) is reference_from_head; `single_angles_rad` (n, 3) what single exposures are
    off it about the head's axes, none where the heads were parameters of the adjustment.
    """

    head: str
    rotation: Array
    single_angles_rad: Array
    exposures: int

    @property
    def spread_rad(self) -> Array:
        """(3,) standard deviation of single exposures; NaN where there are not two."""
        if len(self.single_angles_rad) < 2:
            return np.full(3, np.nan)
        return np.asarray(self.single_angles_rad.std(axis=0, ddof=1))


@dataclass(frozen=True)
class RelativeOrientations:
    """All heads but the reference.

    `covariance` (3h, 3h), rad squared, of rotation vectors about each head's own axes;
    `squares` is the mean square of single exposures about the averages in their own covariance
    (one where the rig did not move between exposures), NaN where there are none.
    """

    reference: str
    heads: tuple[RelativeOrientation, ...]
    covariance: Array
    squares: float
    redundancy: int

    def sigma_rad(self, head: int) -> Array:
        """Standard deviations of a head's rotation about its own axes.

        Args:
            head: index into `heads`.

        Returns:
            Shape (3,), rad.
        """
        own = self.covariance[3 * head : 3 * head + 3, 3 * head : 3 * head + 3]
        return np.asarray(np.sqrt(np.diag(own)))

    def angles(self, head: int) -> tuple[Array, Array]:
        """Angles of a head, R = Ry(phi) Rx(omega) Rz(kappa), reference from head.

        Args:
            head: index into `heads`.

        Returns:
            (phi, omega, kappa) and their standard deviations, shape (3,) each, rad.
        """
        rotation = self.heads[head].rotation
        by = angles_by_rotation_vector("YXZ", rotation)
        own = self.covariance[3 * head : 3 * head + 3, 3 * head : 3 * head + 3]
        return phi_omega_kappa(rotation), np.sqrt(np.diag(by @ own @ by.T))


def relative_orientations(
    result: Adjustment, reference: str, *, least_points: int = 10
) -> RelativeOrientations:
    """Relative orientations of an adjusted block.

    Where the network has heads, they were parameters and are taken as adjusted; else each exposure
    (station) with an image of the reference camera counts.

    Args:
        result: the block, images with attitudes of their own or heads.
        reference: the camera (head) the others are turned against.
        least_points: image points that an image needs to count.

    Returns:
        Rotations of the other heads with their covariance.

    Raises:
        ValueError: no such camera, or no exposure with it and another one.

    Source: docs/explanation/mathematics/boresight.md#relative-orientation-of-heads.
    """
    names = [camera.name for camera in result.network.cameras]
    if reference not in names:
        raise ValueError(f"no camera {reference!r}; there are {', '.join(names)}")
    if any(head.rotation_free for head in result.network.heads):
        return _of_parameters(result, reference)
    return _averaged(result, reference, _pairs(result, names.index(reference), least_points))


def average_rotations(
    reference_rotation: Array, head_rotation: Array, head: Indices, covariance: Array, heads: int
) -> tuple[Array, Array, Array]:
    """Mean relative rotations by generalised least squares.

    Args:
        reference_rotation: object from reference camera, pair by pair, shape (n, 3, 3).
        head_rotation: object from camera of the head, pair by pair, shape (n, 3, 3).
        head: which head a pair is of, shape (n,).
        covariance: of their rotation vectors, reference, then head, of every pair, shape (6n, 6n),
            rad squared.
        heads: how many; each has a pair.

    Returns:
        Rotations reference_from_head, shape (heads, 3, 3); their covariance, shape
        (3 heads, 3 heads), rad squared; what single pairs are off about the head's axes, shape
        (n, 3), rad.

    Example:
        Two pairs at 0.1 and 0.3 rad: their mean is 0.2, each is 0.1 off.

        >>> from processing.geometry.rotation import rotation_matrix
        >>> turned = np.array([rotation_matrix(0.0, 0.0, angle) for angle in (0.1, 0.3)])
        >>> level = np.array([np.eye(3), np.eye(3)])
        >>> mean, _, off = average_rotations(level, turned, np.zeros(2, int), 1e-6 * np.eye(12), 1)
        >>> vectors_from_rotations(mean)[0].round(6), off[:, 2].round(6)
        (array([0. , 0. , 0.2]), array([-0.1,  0.1]))
    """
    n = len(head)
    relative = np.einsum("nji,njk->nik", reference_rotation, head_rotation)
    mean = np.array([relative[head == h][0] for h in range(heads)])
    design = np.zeros((n, 3, heads, 3))
    for k in range(n):
        design[k, :, head[k], :] = np.eye(3)
    a = design.reshape(3 * n, 3 * heads)
    for _ in range(_ITERATIONS):
        off = vectors_from_rotations(np.einsum("nji,njk->nik", mean[head], relative))
        by = np.zeros((n, 3, n, 6))
        for k in range(n):
            by[k, :, k, :3] = -mean[head[k]].T
            by[k, :, k, 3:] = np.eye(3)
        flat = by.reshape(3 * n, 6 * n)
        weight = np.linalg.inv(flat @ covariance @ flat.T)
        cofactor = np.linalg.inv(a.T @ weight @ a)
        step = (cofactor @ (a.T @ weight @ off.ravel())).reshape(heads, 3)
        mean = mean @ rotations_from_vectors(step)
        if np.abs(step).max() < _CONVERGED_RAD:
            break
    off = vectors_from_rotations(np.einsum("nji,njk->nik", mean[head], relative))
    return np.asarray(mean), np.asarray(cofactor), off


def _averaged(
    result: Adjustment, reference: str, pairs: Sequence[tuple[int, int, int]]
) -> RelativeOrientations:
    cameras = list(dict.fromkeys(camera for _, _, camera in pairs))
    first = np.array([p[0] for p in pairs])
    second = np.array([p[1] for p in pairs])
    head = np.array([cameras.index(p[2]) for p in pairs])
    at = np.concatenate(
        [
            np.concatenate([result.layout.attitude[a], result.layout.attitude[b]])
            for a, b in zip(first, second, strict=True)
        ]
    )
    covariance = result.sigma0**2 * result.cofactor[np.ix_(at, at)]
    covariance[np.ix_(at < 0, at < 0)] = 0.0
    mean, own, off = average_rotations(
        result.state.attitude[first], result.state.attitude[second], head, covariance, len(cameras)
    )
    redundancy = 3 * (len(pairs) - len(cameras))
    by = np.zeros((len(pairs), 3, len(pairs), 6))
    for k, h in enumerate(head):
        by[k, :, k, :3], by[k, :, k, 3:] = -mean[h].T, np.eye(3)
    flat = by.reshape(3 * len(pairs), -1)
    squares = float(off.ravel() @ np.linalg.solve(flat @ covariance @ flat.T, off.ravel()))
    return RelativeOrientations(
        reference=reference,
        heads=tuple(
            RelativeOrientation(
                result.network.cameras[camera].name,
                mean[h],
                off[head == h],
                int((head == h).sum()),
            )
            for h, camera in enumerate(cameras)
        ),
        covariance=own,
        squares=squares / redundancy if redundancy else math.nan,
        redundancy=redundancy,
    )


def _pairs(result: Adjustment, reference: int, least_points: int) -> list[tuple[int, int, int]]:
    """(attitude of the reference image, attitude of another of the exposure, its camera)."""
    images = result.network.images
    used = result.weight > 0.0
    seen = np.bincount(result.network.image_points.image[used], minlength=len(images.names))
    by_station: dict[int, int] = {}
    for image in np.flatnonzero((images.camera == reference) & (seen >= least_points)):
        by_station[int(images.station[image])] = int(images.attitude[image])
    pairs = [
        (by_station[int(images.station[i])], int(images.attitude[i]), int(images.camera[i]))
        for i in np.flatnonzero((images.camera != reference) & (seen >= least_points))
        if int(images.station[i]) in by_station
    ]
    if any(a == b for a, b, _ in pairs):
        raise ValueError(
            "images of an exposure share one attitude and no head is free: give the images angles "
            'of their own, or heads with rotation = "free"'
        )
    if not pairs:
        raise ValueError(
            f"no exposure has an image of the reference camera and of another one with "
            f"{least_points} points each"
        )
    return sorted(pairs, key=lambda p: p[2])


def _of_parameters(result: Adjustment, reference: str) -> RelativeOrientations:
    network, layout = result.network, result.layout
    by_name: Mapping[str, int] = {head.name: k for k, head in enumerate(network.heads)}
    base = by_name.get(reference)
    if base is not None and network.heads[base].rotation_free:
        raise ValueError(
            f"head {reference!r} is the reference and free: hold it, all others are against it"
        )
    rotation_change = np.eye(3) if base is None else network.heads[base].rotation
    free = [k for k, head in enumerate(network.heads) if head.rotation_free]
    at = np.concatenate([layout.head_rotation[k] for k in free])
    seen = {
        k: len(np.unique(network.images.station[network.images.head == k]))
        for k in range(len(by_name))
    }
    return RelativeOrientations(
        reference=reference,
        heads=tuple(
            RelativeOrientation(
                network.heads[k].name,
                rotation_change.T @ result.state.head_rotation[k],
                np.zeros((0, 3)),
                seen[k],
            )
            for k in free
        ),
        covariance=result.sigma0**2 * result.cofactor[np.ix_(at, at)],
        squares=math.nan,
        redundancy=0,
    )
