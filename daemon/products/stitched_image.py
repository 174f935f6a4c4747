"""Level-2 of a rig with a virtual image: one image, its colour, geometry and residuals.

What they are is made by `processing.pipelines.stitched`; here they get their files.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from daemon.mission.exposure import Exposure
from daemon.mission.store import level2
from daemon.products.product_files import FramesRead, ProductFiles, report_json
from processing.mosaic.mosaic_plots import residuals_svg
from processing.mosaic.residual_vectors import residual_vectors
from processing.mosaic.stitch_record import stitch_record, stitch_record_json
from processing.mosaic.stitching_patterns import (
    PATTERNS_KEY,
    patterns_json,
    stitching_patterns,
)
from processing.pipelines.stitched import Conditions, Pipeline


def build_stitched(
    pipeline: Pipeline,
    exposure: Exposure,
    frames: Mapping[str, NDArray[np.uint16]],
    conditions: Conditions,
    frames_read: FramesRead,
) -> ProductFiles:
    """One image of all heads (`daemon.products.processor`).

    Pixels in what comes back are the pipeline's buffers, until its next exposure.
    """
    rig = pipeline.rig
    product = pipeline.process(frames, conditions, frames_read=frames_read)
    temperatures = product.temperatures
    stitching = None
    if product.mosaic.method == "free":
        stitching = stitch_record_json(
            stitch_record(
                rig,
                product.mosaic,
                temperatures.placement_temperatures_c,
                temperatures.usable_c,
                product.estimated_dc,
                bands=product.bands,
                height_m=conditions.height_above_ground_m,
            )
        ) | {PATTERNS_KEY: patterns_json(stitching_patterns(rig, product.mosaic))}
    report = report_json(product.report, exposure.number, product.timings_s, product.valid_area)
    contents = level2.level2_contents(
        exposure.number,
        pan=product.pan,
        colour=product.colour,
        quicklook=product.quicklook,
        report_json=report,
        geometry=product.geometry,
        residuals_svg=residuals_svg(rig, product.tie_points, product.mosaic, product.validity),
        residuals_json=residual_vectors(rig, product.tie_points, product.mosaic),
        mosaic_json=stitching,
    )
    return report, contents
