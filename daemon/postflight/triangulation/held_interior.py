"""What holding the principal point of photographs does to the estimated principal distance.

A photograph's principal point is not known from EXIF and is held in the middle: with few lines over
flat ground it is hardly separated from the tilts. If photographs contradict this, the stated
standard deviation of the principal distance holds for the chosen parameters only.

Source: Fraser (1997), section 5 (projective coupling of interior and exterior orientation).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from daemon.postflight.adjustment.adjusted_project import used_network
from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.camera_model import perspective_mm
from processing.bundle.network import INTERIOR, CameraModel, NetworkError
from processing.bundle.rank_diagnosis import RankDefectError

SIGNIFICANT: Final = 4.0
"""Of the principal point in its standard deviations; 6 in 100,000 of right ones are beyond."""
F_CHANGE: Final = 3.0
"""Change of the principal distance in its standard deviations that is worth a caution."""
PRINCIPAL_POINT_SHARE: Final = 0.01
"""A priori standard deviation of the principal point, of the image's longer side."""
_POINT: Final = ("dx0", "dy0")
_SETTINGS: Final = AdjustmentSettings(max_iterations=300, variance_components=True)
"""Weak blocks come to rest slowly."""


@dataclass(frozen=True)
class FreePrincipalPoint:
    """The interior orientation with an estimated principal point, in pixels.

    `change_px` is that of the principal distance against the held principal point, `point_px` the
    principal point's column and row from the middle, `f_sigma_px` the standard deviation of the
    principal distance with it.
    """

    change_px: float
    point_px: tuple[float, float]
    point_sigma_px: tuple[float, float]
    f_sigma_px: float

    def contradicts(self, f_sigma_px: float) -> bool:
        """Whether the point is off the middle and f changes beyond its standard deviation."""
        pairs = zip(self.point_px, self.point_sigma_px, strict=True)
        is_off = any(abs(value) > SIGNIFICANT * sigma for value, sigma in pairs)
        return is_off and abs(self.change_px) > F_CHANGE * f_sigma_px

    def widens(self, f_sigma_px: float) -> bool:
        """Whether the principal distance is much less accurate than with a held point."""
        return bool(self.f_sigma_px > F_CHANGE * f_sigma_px)


def free_principal_point(
    result: Adjustment,
    *,
    longer_side_px: Sequence[int],
    progress: Callable[[str, int, float], None] | None = None,
) -> tuple[FreePrincipalPoint, ...] | None:
    """Adjust the used observations once more, with the principal point free.

    Args:
        result: adjusted photographs; cameras have a pixel size.
        longer_side_px: of the photographs of each camera; its principal point has a standard
            deviation of 1 % of it a priori.
        progress: see `adjust`.

    Returns:
        The change of each camera; None where that adjustment has no solution.
    """
    network, state = used_network(result), result.state
    if all(camera.free.issuperset(_POINT) for camera in network.cameras):
        return _changes(result, result)
    cameras = with_principal_point(network.cameras, longer_side_px)
    network = replace(
        network,
        cameras=tuple(
            replace(camera, interior=interior)
            for camera, interior in zip(cameras, state.interior, strict=True)
        ),
        stations=replace(network.stations, position_m=state.station),
        attitudes=replace(network.attitudes, rotation=state.attitude),
        points=replace(
            network.points,
            xyz_m=np.where(np.isfinite(network.points.sigma_m), network.points.xyz_m, state.points),
        ),
    )
    try:
        free = adjust(network, _SETTINGS, progress=progress)
    except (NetworkError, RankDefectError):
        return None
    return _changes(result, free)


def with_principal_point(
    cameras: Sequence[CameraModel], longer_side_px: Sequence[int]
) -> tuple[CameraModel, ...]:
    """The cameras with an unknown principal point, which is observed in the middle.

    Args:
        cameras: of photographs; without a pixel size it is 1 um.
        longer_side_px: of the photographs of each camera; the standard deviation is 1 % of it.
    """
    return tuple(
        replace(
            camera,
            free=camera.free | set(_POINT),
            sigma={
                **camera.sigma,
                **dict.fromkeys(_POINT, PRINCIPAL_POINT_SHARE * side * _pitch_mm(camera)),
            },
        )
        for camera, side in zip(cameras, longer_side_px, strict=True)
    )


def _pitch_mm(camera: CameraModel) -> float:
    return camera.pixel_mm or 1e-3


def _changes(held: Adjustment, free: Adjustment) -> tuple[FreePrincipalPoint, ...]:
    """Of each camera, from one adjustment to the other."""
    found = []
    for k, camera in enumerate(held.network.cameras):
        pitch = _pitch_mm(camera)
        columns, interior = free.layout.interior[k], free.state.interior[k]
        f_mm, x_mm, y_mm = perspective_mm(camera, interior)
        change_mm = f_mm - perspective_mm(camera, held.state.interior[k])[0]
        sigma0 = free.sigma0 * f_mm / camera.f_mm
        sx, sy, sf = (
            sigma0 * float(np.sqrt(free.cofactor[column, column])) / pitch if column >= 0 else 0.0
            for column in (columns[INTERIOR.index(name)] for name in (*_POINT, "df"))
        )
        # y is up in mm, down in px.
        point_px = (x_mm - camera.xp_mm) / pitch, (camera.yp_mm - y_mm) / pitch
        found.append(
            FreePrincipalPoint(change_mm / pitch, point_px, (sx, sy), sf * f_mm / camera.f_mm)
        )
    return tuple(found)
