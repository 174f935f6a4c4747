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
from processing.bundle.network import INTERIOR, NetworkError
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
    principal point's column and row from the middle.
    """

    change_px: float
    point_px: tuple[float, float]
    point_sigma_px: tuple[float, float]

    def contradicts(self, f_sigma_px: float) -> bool:
        """Whether the point is off the middle and f changes beyond its standard deviation."""
        pairs = zip(self.point_px, self.point_sigma_px, strict=True)
        is_off = any(abs(value) > SIGNIFICANT * sigma for value, sigma in pairs)
        return is_off and abs(self.change_px) > F_CHANGE * f_sigma_px


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
    pitch_mm = [camera.pixel_mm or 1e-3 for camera in network.cameras]
    network = replace(
        network,
        cameras=tuple(
            replace(
                camera,
                interior=interior,
                free=camera.free | set(_POINT),
                sigma={
                    **camera.sigma,
                    **dict.fromkeys(_POINT, PRINCIPAL_POINT_SHARE * side * pitch),
                },
            )
            for camera, interior, side, pitch in zip(
                network.cameras, state.interior, longer_side_px, pitch_mm, strict=True
            )
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
    at = {name: INTERIOR.index(name) for name in ("df", *_POINT)}
    found = []
    for k, pitch in enumerate(pitch_mm):
        columns = free.layout.interior[k]
        change = state.interior[k][at["df"]] - free.state.interior[k][at["df"]]
        x, y = (float(free.state.interior[k][at[name]]) / pitch for name in _POINT)
        sx, sy = (
            free.sigma0
            * float(np.sqrt(free.cofactor[columns[at[name]], columns[at[name]]]))
            / pitch
            for name in _POINT
        )
        # Coordinates are corrected by dx0 and dy0, and y is up.
        found.append(FreePrincipalPoint(float(change) / pitch, (-x, y), (sx, sy)))
    return tuple(found)
