"""The order of the angles: omega about x first, seen from the object."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processing.geometry.rotation import rotation_matrix


@pytest.mark.parametrize("angles", [(0.3, -0.7, 1.9), (-1.1, 0.4, -2.5)])
def test_the_matrix_is_rx_ry_rz(angles: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("XYZ", angles).as_matrix()
    np.testing.assert_allclose(rotation_matrix(*angles), expected, atol=1e-15)
