"""Errors of image points do not pull the interior orientation of a weakly determined block."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.bundle.adjust import adjust
from processing.bundle.forward_models import forward_measured_mm
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    CameraModel,
    Gnss,
    ImagePoints,
    Images,
    Network,
    Points,
    Stations,
)
from processing.geometry.lens import Lens, measured_from_ideal
from processing.geometry.rotation import rotation_matrix

F_MM, HALF_MM = 4.0, (2.4, 1.8)
TRUE = {
    "australis": {"df": 0.02, "k1": 4e-3, "k2": -6e-5},
    "opencv": {"df": 0.02, "k1": -0.06, "k2": 0.02},
}
SIGMA_MM = {"australis": 0.0015, "opencv": 0.012}
"""Large enough that an estimate which errors pull is beyond three standard deviations."""


def measured_mm(model: str, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Image coordinates of directions (n, 2)."""
    true = TRUE[model]
    if model == "australis":
        lens = Lens(f_mm=F_MM, df_mm=true["df"], k1=true["k1"], k2=true["k2"])
        return measured_from_ideal(lens, F_MM * directions)
    interior = np.array([true.get(name, 0.0) for name in INTERIOR])
    return forward_measured_mm(CameraModel("C", F_MM, model="opencv"), interior, directions)


def noisy_block(model: str, seed: int) -> Network:
    """Fifteen images, nearly nadir, three lines over hills; positions of 3 m, one camera."""
    random = np.random.default_rng(seed)
    n = 15
    line, along = np.divmod(np.arange(n), 5)
    station = np.column_stack([13.0 * (along - 2), 25.0 * (line - 1), np.full(n, 60.0)])
    station += random.normal(0.0, 0.7, (n, 3))
    heading = np.where(line % 2 == 0, 0.0, np.pi)
    rotation = np.array([rotation_matrix(*random.normal(0.0, 0.04, 2), k) for k in heading])
    ground = random.uniform([-60.0, -55.0, -5.0], [60.0, 55.0, 5.0], (900, 3))
    seen = np.einsum("nij,npi->npj", rotation, ground[None] - station[:, None])
    directions = -seen[:, :, :2] / seen[:, :, 2:]
    inside = (np.abs(F_MM * directions) < HALF_MM).all(axis=2)
    often = inside.sum(axis=0) >= 3
    ground, inside, directions = ground[often], inside[:, often], directions[:, often]
    image, point = np.nonzero(inside)
    sigma_mm = SIGMA_MM[model]
    xy = measured_mm(model, directions[image, point])
    xy = xy + random.normal(0.0, sigma_mm, xy.shape)
    names = tuple(f"i{k}" for k in range(n))
    every = np.arange(n)
    return Network(
        cameras=(CameraModel("C", F_MM, free=frozenset(TRUE[model]), model=model),),
        stations=Stations(names, station, np.zeros(n, bool)),
        attitudes=Attitudes(names, rotation, np.zeros(n, bool)),
        images=Images(names, every, every, np.zeros(n, np.int64), np.full(n, -1)),
        points=Points(
            tuple(f"p{k}" for k in range(len(ground))),
            ground,
            np.full((len(ground), 3), np.nan),
            np.zeros(len(ground), bool),
        ),
        image_points=ImagePoints(image, point, xy, np.full((len(xy), 2), sigma_mm)),
        gnss=Gnss(
            station=every,
            attitude=every,
            position_m=station + random.normal(0.0, 3.0, (n, 3)),
            sigma_m=np.full((n, 3), 3.0),
            lever_m=np.zeros((n, 3)),
            line=np.full(n, -1),
            time_s=np.zeros(n),
            lines=(),
            drift="none",
        ),
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("model", TRUE)
def test_the_interior_orientation_is_within_its_standard_deviations(model: str, seed: int) -> None:
    result = adjust(noisy_block(model, seed))
    for name, true in TRUE[model].items():
        k = INTERIOR.index(name)
        column = result.layout.interior[0][k]
        sigma = result.sigma0 * float(np.sqrt(result.cofactor[column, column]))
        assert result.state.interior[0][k] == pytest.approx(true, abs=3.0 * sigma), name
