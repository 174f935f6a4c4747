"""Which compiled kernels there are, and compiling them before a flight: none compiles in the air.

Kernels are cached on disk (numba; `NUMBA_CACHE_DIR` where the service sets it), so that after the
installation a start only loads them.
"""

from __future__ import annotations

import fcntl
import importlib
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba.core.dispatcher import Dispatcher

from processing.bundle.smallest_block import adjust_smallest_block
from processing.pipelines.bands import BandPipeline
from processing.pipelines.parallel_compilation import (
    COMPILATION_TIMEOUT_S,
    VARIANTS_FILE,
    KernelCompilationError,
    Progress,
    compile_recorded,
    missing_variants,
    recorded_variants,
)
from processing.pipelines.perspective import HeadPipeline, has_head_images
from processing.pipelines.stitched import Pipeline, PipelineSettings
from processing.pipelines.synthetic_frames import synthetic_radiometry
from processing.radiometry.calibration import RadiometricCalibration
from processing.radiometry.demosaic import demosaic
from processing.rig import Rig

_KERNEL_MODULES: Final = (
    "processing.bundle.eliminated_products",
    "processing.image.balance",
    "processing.image.cells",
    "processing.matching.correlation",
    "processing.radiometry.demosaic",
    "processing.matching.features",
    "processing.image.line_means",
    "processing.quality.common_windows",
    "processing.quality.defect_lines",
    "processing.quality.frame_blocks",
    "processing.quality.frame_rectangles",
    "processing.quality.line_order",
    "processing.quality.local_sharpness",
    "processing.quality.sharp_changes",
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


def compile_missing() -> None:
    """Let another process compile recorded variants that are not in the cache; this one loads them.

    A process that compiles a kernel itself takes the calls within it to copies of other kernels
    that later processes, which load it, do not have: its images differ in last bits. Processes that
    do so at once wait for the first.

    Raises:
        KernelCompilationError: a kernel could not be compiled.
    """
    table = recorded_variants()
    if not missing_variants(kernels(), table):
        return
    with VARIANTS_FILE.open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # held for COMPILATION_TIMEOUT_S at most
        missing = missing_variants(kernels(), table)
        if not missing:
            return
        try:
            done = subprocess.run(
                [sys.executable, "-m", __name__, *missing],
                capture_output=True, text=True, timeout=COMPILATION_TIMEOUT_S, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise KernelCompilationError(
                f"kernels were not compiled within {COMPILATION_TIMEOUT_S:.0f} s; run: syntopic "
                "kernels"
            ) from None
    if done.returncode != 0:
        reason = done.stderr.strip() or f"their compiler ended with {done.returncode}"
        raise KernelCompilationError(reason)


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
    is compiled as well. So are what a Bayer head needs, whether this rig has one or not, and what
    bundle adjustments call.

    Args:
        rig: the camera.
        radiometry: calibrations by sensor name.
        settings: of the pipeline; None takes those under which it does all it can.
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
    adjust_smallest_block()
    demosaic(np.zeros((8, 8), np.uint16), "RGGB", out=np.zeros((3, 8, 8), np.uint16))
    if rig.virtual_image is not None:
        complete = PipelineSettings(baselines=True, geometry=True)
        Pipeline(rig, radiometry, settings or complete).warm_up()
    elif has_head_images(rig):
        HeadPipeline(rig, radiometry).warm_up()
    else:
        BandPipeline(rig).warm_up()
    compiled += _cache_misses() - before
    return Compilation(variants(), compiled, time.perf_counter() - began)


def _cache_misses() -> int:
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels().values())


def main(names: Sequence[str]) -> int:
    """Compile recorded variants that are not in the cache.

    Args:
        names: of the kernels, "module.function".

    Returns:
        The exit status.
    """
    table = recorded_variants()
    try:
        compile_recorded(kernels(), table={name: table[name] for name in names})
    except KernelCompilationError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
