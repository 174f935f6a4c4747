"""Conversion of a camera to another model, with what the other model cannot follow.

The parameters of the other model are those that best place a grid over the frame: residuals are in
the image. Programs of other formats are converted in `daemon.postflight.exchange`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from processing.bundle.camera_model import ideal_mm, measured_by_ideal, principal_distance_mm
from processing.bundle.forward_models import FORWARD, forward_measured_mm
from processing.bundle.network import CameraModel, Model, NetworkError

Array = NDArray[np.float64]

_SIDE: Final = 21


@dataclass(frozen=True)
class ConvertedCamera:
    """A camera of another model, and the residuals of the conversion in the image, mm."""

    camera: CameraModel
    rms_mm: float
    largest_mm: float


def converted_camera(
    camera: CameraModel, model: Model, half_size_mm: tuple[float, float]
) -> ConvertedCamera:
    """The camera with another model.

    Args:
        camera: without additional parameters; its `interior` is converted.
        model: of the result; f and principal point stay.
        half_size_mm: half width and half height of the frame.

    Returns:
        The camera with the residuals of a grid over the frame.

    Raises:
        NetworkError: additional parameters, or a distortion that cannot be inverted over the frame.

    Source: docs/explanation/mathematics/bundle.md#forward-models.
    """
    if camera.terms:
        raise NetworkError([f"camera {camera.name}: additional parameters cannot be converted"])
    measured = frame_grid(camera, half_size_mm)
    wanted = ideal_mm(camera, camera.interior, np.zeros(0), measured)
    wanted = wanted / principal_distance_mm(camera, camera.interior)
    to_image = measured_by_ideal(camera, camera.interior, measured)
    return fitted_camera(replace(camera, model=model), measured, wanted, to_image)


def frame_grid(camera: CameraModel, half_size_mm: tuple[float, float]) -> Array:
    """Image points over the frame of a camera.

    Args:
        camera: its principal point.
        half_size_mm: half width and half height of the frame.

    Returns:
        Shape (n, 2), mm.
    """
    axes = [np.linspace(-half, half, _SIDE) for half in half_size_mm]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    return np.asarray(grid + np.array([camera.xp_mm, camera.yp_mm]))


def fitted_camera(
    camera: CameraModel, measured: Array, wanted: Array, to_image: Array | None = None
) -> ConvertedCamera:
    """The camera with the ten that best place directions where they were measured.

    Args:
        camera: model, f and principal point; its `interior` is replaced.
        measured: image points, shape (n, 2), mm.
        wanted: their ideal coordinates over the principal distance, shape (n, 2), y up.
        to_image: derivatives of measured by ideal coordinates, shape (n, 2, 2), where residuals of
            a model that corrects measured coordinates are to be those of the image; None: one.

    Returns:
        The camera and its residuals.
    """
    model, none = camera.model, np.zeros(0)
    target = replace(camera, interior=np.zeros(10))
    own = np.array([k for k in range(10) if not (model == "fisheye" and k == 7)])
    about = measured - np.array([camera.xp_mm, camera.yp_mm])
    scale = _scales(model, float(np.linalg.norm(about, axis=1).max()), camera.f_mm)[own]

    def residuals(values: Array) -> Array:
        interior = np.zeros(10)
        interior[own] = values * scale
        if model in FORWARD:
            return np.ravel(forward_measured_mm(target, interior, wanted) - measured)
        found = ideal_mm(target, interior, none, measured)
        off = found - wanted * principal_distance_mm(target, interior)
        if to_image is not None:
            off = np.einsum("nij,nj->ni", to_image, off)
        return np.ravel(off)

    fit = least_squares(residuals, np.zeros(len(own)), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    interior = np.zeros(10)
    interior[own] = fit.x * scale
    size = np.linalg.norm(fit.fun.reshape(-1, 2), axis=1)
    return ConvertedCamera(
        replace(target, interior=interior),
        float(np.sqrt(np.mean(size**2))),
        float(size.max()),
    )


def _scales(model: Model, reach_mm: float, f_mm: float) -> Array:
    """What each of the ten changes coordinates at the edge of the frame by about 0.01 mm with."""
    unit = f_mm if model in ("opencv", "fisheye") else 1.0
    reach = reach_mm / unit
    edge = 1e-2 / reach_mm
    radial = [edge / reach**power for power in (2, 4, 6)]
    decentring = [edge / reach] * 2
    return np.array([1e-2, 1e-2, 1e-2, *radial, *decentring, edge, edge])
