"""A stitched product has the same bits whatever number of threads computes it."""

from __future__ import annotations

import numpy as np
import pytest

from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.quality.report import as_json
from tests.processing.injected_errors import rendered

THREADS = 2


@pytest.mark.timeout(300)
def test_the_bits_of_a_product_do_not_depend_on_threads() -> None:
    exposure = rendered("ultracam-x-mini")

    def product(threads: int) -> Product:
        pipeline = Pipeline(exposure.rig, exposure.radiometry, PipelineSettings(threads=threads))
        return pipeline.process(exposure.frames, exposure.conditions)

    one, several = product(1), product(THREADS)
    assert np.array_equal(one.pan, several.pan)
    assert np.array_equal(one.quicklook, several.quicklook)
    assert one.colour.keys() == several.colour.keys()
    for band in one.colour:
        assert np.array_equal(one.colour[band], several.colour[band]), band
    assert np.array_equal(one.mosaic.values, several.mosaic.values)
    assert np.array_equal(one.mosaic.covariance, several.mosaic.covariance)
    assert np.array_equal(one.tie_points.raw_b, several.tie_points.raw_b)
    assert as_json(one.report) == as_json(several.report)
