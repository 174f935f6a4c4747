"""`python -m benchmarks.accelerator RIG`: correction and resampling by device, in turn.

Processes synthetic frames on the processor in floating point ("cpu") and in integers
("cuda-reference"), and on a CUDA device where there is one. Without one the reason is printed and
nothing is stated of it. Exits with 1 where the pixels of the device are not those of
"cuda-reference".
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.cli.benchmark.measurement import machine
from daemon.products.processing_threads import configure_threads
from processing.geometry.conditions import Conditions
from processing.image.accelerator.devices import DEVICES, Device, why_unusable
from processing.pipelines.product import PipelineSettings, Product
from processing.pipelines.stitched import Pipeline
from processing.pipelines.synthetic_frames import synthetic_frames, synthetic_radiometry
from processing.rig import Rig, find_rig

STAGES: Final = ("radiometry", "composition", "colour")
"""Stages that an accelerator shares in; each has parts that stay with the processor."""
DIFFERENT_BITS: Final = 1
Rasters = Mapping[str, NDArray[Any]]


def main() -> int:
    """Measure, print one JSON object, and return the exit status."""
    line = argparse.ArgumentParser(prog="python -m benchmarks.accelerator", description=__doc__)
    line.add_argument("rig", help="name of a shipped rig that is stitched")
    line.add_argument("--runs", type=int, default=5)
    options = line.parse_args()
    found = measure(find_rig(options.rig), options.runs)
    print(json.dumps({"machine": machine(), "rig": options.rig, **found}, indent=1))
    return DIFFERENT_BITS if found["cuda_has_the_bits_of_cuda_reference"] is False else 0


def measure(rig: Rig, runs: int) -> dict[str, Any]:
    """Median seconds of the stages by device, and how the pixels differ.

    Args:
        rig: a rig with a virtual image.
        runs: of each device, in turn.
    """
    configure_threads()
    reason = why_unusable("cuda")
    usable: list[Device] = [device for device in DEVICES if device != "cuda" or reason is None]
    radiometry = {sensor.name: synthetic_radiometry(sensor) for sensor in rig.sensors}
    frames = synthetic_frames(rig)
    conditions = Conditions(
        temperatures_c=dict.fromkeys(rig.probes, 20.0),
        exposure_time_s={sensor.name: 0.005 for sensor in rig.sensors},
        tdi_shifts={sensor.name: 1 for sensor in rig.sensors},
    )
    pipelines = {
        device: Pipeline(rig, radiometry, PipelineSettings(geometry=False, device=device))
        for device in usable
    }
    pixels = {
        device: rasters_of(pipeline.process(frames, conditions))
        for device, pipeline in pipelines.items()
    }
    seconds: dict[Device, dict[str, list[float]]] = {
        device: {stage: [] for stage in STAGES} for device in usable
    }
    for _ in range(runs):
        for device, pipeline in pipelines.items():
            timings_s = pipeline.process(frames, conditions).timings_s
            for stage in STAGES:
                seconds[device][stage].append(timings_s[stage])
    return {
        "median_s": {
            device: {stage: round(statistics.median(s), 4) for stage, s in stages.items()}
            for device, stages in seconds.items()
        },
        "cuda": "measured" if reason is None else f"not measured: {reason}",
        "cuda_has_the_bits_of_cuda_reference": None
        if reason is not None
        else same_bits(pixels["cuda"], pixels["cuda-reference"]),
        "cpu_against_cuda_reference": differences(pixels["cpu"], pixels["cuda-reference"]),
    }


def rasters_of(product: Product) -> Rasters:
    """Copies of the rasters of a product by name."""
    rasters = {"pan": product.pan, "provenance": product.valid, **product.colour}
    return {name: raster.copy() for name, raster in rasters.items()}


def same_bits(one: Rasters, other: Rasters) -> bool:
    """Whether all rasters of two products are equal word by word."""
    return all(np.array_equal(raster, other[name]) for name, raster in one.items())


def differences(one: Rasters, other: Rasters) -> dict[str, dict[str, float]]:
    """Share of pixels that differ, standard deviation and largest difference, Level-1 counts."""
    found = {}
    for name, raster in one.items():
        off = raster.astype(np.int32) - other[name]
        found[name] = {
            "differing_fraction": round(float(np.mean(off != 0)), 6),
            "standard_deviation": round(float(off.std()), 3),
            "largest": int(np.abs(off).max()),
        }
    return found


if __name__ == "__main__":
    sys.exit(main())
