"""One small flight for all tests of the orthomosaic."""

from __future__ import annotations

import pytest

from benchmarks.orthomosaic import GroundTruth, OrthoFlight, fly

CRS = "EPSG:32633"


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> OrthoFlight:
    """Eight images in two lines under uneven light, and the true height model."""
    flown = fly(tmp_path_factory.mktemp("block"), width_px=1182, exposures=3)
    GroundTruth(flown, CRS).write_height_model(flown.folder / "dtm.asc", step_m=20.0)
    return flown
