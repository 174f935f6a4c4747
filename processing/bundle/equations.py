"""Observation equations of a network: misclosures and analytic derivatives, whitened.

Every row is divided by its standard deviation, so that normal equations are plain products. Rows
hold entries of columns (`reduced`) and of at most one eliminated object point (`point_part`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.bundle.equation_rows import Equations, RowBuilder
from processing.bundle.image_rows import image_rows
from processing.bundle.network import Network
from processing.bundle.other_rows import other_rows
from processing.bundle.unknowns import ParameterLayout, ParameterValues

Array = NDArray[np.float64]


def equations(
    network: Network,
    layout: ParameterLayout,
    state: ParameterValues,
    weight: Array,
    *,
    derivatives: bool = True,
) -> Equations:
    """All rows at the current state.

    Args:
        network: observations.
        layout: columns.
        state: current values.
        weight: factor on the weight of each image point, shape (image points,); zero leaves it
            out.
        derivatives: without them `reduced` and `point_part` are zero.

    Returns:
        Whitened rows, image points first.

    Raises:
        BehindCameraError: an object point is not in front of a camera that saw it.

    Source: docs/explanation/mathematics/bundle.md#collinearity and #other-observations.
    """
    build = RowBuilder(layout, derivatives)
    image_rows(build, network, layout, state, weight)
    other_rows(build, network, layout, state)
    return build.equations()
