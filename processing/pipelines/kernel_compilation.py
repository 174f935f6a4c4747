"""Which compiled kernels there are, and compiling them before a flight: none compiles in the air.

Kernels are cached on disk (numba; `NUMBA_CACHE_DIR` where the service sets it), so that after the
installation a start only loads them.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba.core.dispatcher import Dispatcher

from processing.pipelines.bands import BandPipeline
from processing.pipelines.parallel_compilation import Progress, compile_recorded
from processing.pipelines.perspective import HeadPipeline, has_head_images
from processing.pipelines.stitched import Pipeline, PipelineSettings
from processing.pipelines.synthetic_frames import synthetic_radiometry
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.demosaic import demosaic
from processing.rig import Rig

_KERNEL_MODULES: Final = (
    "processing.image.balance",
    "processing.image.cells",
    "processing.matching.correlation",
    "processing.radiometry.demosaic",
    "processing.matching.features",
    "processing.image.line_means",
    "processing.quality.common_windows",
    "processing.quality.frame_blocks",
    "processing.quality.local_sharpness",
    "processing.quality.signal_steps",
    "processing.quality.valid_area",
    "processing.matching.least_squares",
    "processing.mosaic.slip_bins",
    "processing.radiometry.defects",
    "processing.radiometry.level1",
    "processing.radiometry.unclean_blocks",
    "processing.matching.patches",
    "processing.matching.prefetch",
    "processing.matching.sampling",
    "processing.image.quicklook",
    "processing.image.resampling",
    "processing.image.seams",
    "processing.image.sharpness",
    "processing.image.taps",
)


@dataclass(frozen=True)
class Compilation:
    """What a warm-up did: variants by kernel, how many of them the cache did not hold, seconds."""

    variants: Mapping[str, int]
    compiled: int
    seconds: float


def kernels() -> dict[str, Any]:
    """All compiled kernels of the package.

    Returns:
        Numba's dispatchers by "module.function", sorted.
    """
    found = {}
    for module_name in _KERNEL_MODULES:
        for name, value in vars(importlib.import_module(module_name)).items():
            if isinstance(value, Dispatcher) and value.py_func.__module__ == module_name:
                found[f"{module_name}.{name}"] = value
    return dict(sorted(found.items()))


def variants() -> dict[str, int]:
    """Count the variants of each kernel, by argument types, that this process holds ready.

    Returns:
        Number by "module.function".
    """
    return {name: len(kernel.signatures) for name, kernel in kernels().items()}


def compile_for(
    rig: Rig,
    radiometry: Mapping[str, RadiometricCalibration] | None = None,
    settings: PipelineSettings | None = None,
    *,
    progress: Progress | None = None,
    processes: int | None = None,
) -> Compilation:
    """Compile, or load from the cache, what this rig's pipeline will call.

    Recorded variants are compiled in several processes. The pipeline then runs once, which compiles
    whatever else it calls. Without radiometry, as at installation, what a calibrated sensor needs
    is compiled as well; so is what a Bayer head needs, whether this rig has one or not.

    Args:
        rig: the camera.
        radiometry: calibrations by sensor name.
        settings: of the pipeline.
        progress: called after each kernel that another process compiled.
        processes: None takes one for each core, 0 compiles in this process as the pipeline runs.

    Returns:
        Variants by kernel, how many were compiled, and the seconds it took.

    Raises:
        KernelCompilationError: a recorded variant cannot be compiled.
        ValueError, CalibrationError: as `Pipeline`, `HeadPipeline` or `BandPipeline`.
    """
    began = time.perf_counter()
    compiled = 0
    if processes != 0:
        compiled = compile_recorded(kernels(), progress=progress, processes=processes)
    before = _cache_misses()
    if radiometry is None:
        first = (rig.pan_cones or rig.cones)[0].sensors[0]
        radiometry = {first.name: synthetic_radiometry(first)}
    demosaic(np.zeros((8, 8), np.uint16), "RGGB", out=np.zeros((3, 8, 8), np.uint16))
    if rig.virtual_image is not None:
        Pipeline(rig, radiometry, settings).warm_up()
    elif has_head_images(rig):
        HeadPipeline(rig, radiometry).warm_up()
    else:
        BandPipeline(rig).warm_up()
    compiled += _cache_misses() - before
    return Compilation(variants(), compiled, time.perf_counter() - began)


def _cache_misses() -> int:
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels().values())
