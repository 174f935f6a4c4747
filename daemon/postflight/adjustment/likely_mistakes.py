"""A mistake that explains a bad adjustment: mirrored image coordinates are adjusted instead.

The trial costs an adjustment and is made only where sigma0 is far off or nothing converged.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from processing import ProcessingError
from processing.bundle.adjust import AdjustmentSettings, adjust
from processing.bundle.initial_values import completed
from processing.bundle.network import Network

SUSPICIOUS_SIGMA0: Final = 20.0
"""Sigma0 beyond which mirrored coordinates are tried."""

_BETTER: Final = 0.2
"""Share of the sigma0 as given below which they explain it."""

_MAX_ITERATIONS: Final = 15


def likely_mistakes(network: Network, sigma0: float | None) -> list[str]:
    """Adjust the mirrored image coordinates.

    A rotation by 180 degrees, such as both signs reversed, is taken by the attitudes and is no
    mistake.

    Args:
        network: as given, before starting values were completed.
        sigma0: of the adjustment as given; None where it failed.

    Returns:
        A sentence if the mirrored coordinates explain the observations; otherwise empty.
    """
    limit = SUSPICIOUS_SIGMA0 if sigma0 is None else _BETTER * sigma0
    table = network.image_points
    mirrored = replace(table, xy_mm=table.xy_mm * np.array([1.0, -1.0]))
    try:
        result = adjust(
            completed(replace(network, image_points=mirrored)),
            AdjustmentSettings(max_iterations=_MAX_ITERATIONS),
        )
    except (ProcessingError, ValueError, ArithmeticError, np.linalg.LinAlgError):
        return []
    if result.redundancy <= 0 or not result.sigma0 < limit:
        return []
    return [
        "image coordinates are mirrored: y points down (as rows of pixels do), x and y are "
        f"exchanged, or X and Y of the control are; with y reversed sigma0 is {result.sigma0:.4g}"
    ]
