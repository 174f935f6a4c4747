"""`python -m tests.processing.image.simulated_accelerator CASE`: kernels in numba's simulator.

Run with NUMBA_ENABLE_CUDASIM=1. Prints by name of each result how many of its words differ from
those of the processor, and how many there are.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.image.accelerator.fixed_resampling import resample_fixed
from processing.image.accelerator.pixel_kernels import pixel_kernels
from processing.image.kernels import INTERPOLATIONS, Interpolation
from processing.image.lattice import OUTSIDE
from processing.radiometry.calibration import RadiometricCalibration, neutral_radiometry
from processing.radiometry.corrector import Corrector, corrector_for
from processing.radiometry.level1 import CPU_PASSES, level1_from_level0, min_raw_value
from processing.radiometry.unclean_blocks import unknown_blocks
from processing.rig import Sensor, find_rig

Array = NDArray[Any]
Differences = dict[str, list[int]]

HOSTILE = (0, 1, 63, 64, 65, 4094, 4095, 4096, 32767, 32768, 65534, 65535)
"""Raw words at the limits of black, of full scale and of the type."""
SUBTLE = 90.0
"""Scale of the case without hostile words."""


def sensor_of(height: int, width: int, row_sign: int) -> Sensor:
    sensor = find_rig("ultracam-x-mini").sensor("SU00")
    return replace(sensor, height_px=height, width_px=width, tdi_row_sign=row_sign)


def raw_frame(sensor: Sensor, seed: int, *, hostile: bool) -> Array:
    """Hostile words, or words just above black, where last bits of the offset decide."""
    rng = np.random.default_rng(seed)
    raw = rng.integers(0, 4096, (sensor.height_px, sensor.width_px)).astype(np.uint16)
    if not hostile:
        raw = raw // 64 + np.uint16(64)
        # Below row 64 of the frame, not of its exposed part.
        raw[66, 40] = 4095
        return raw
    places = rng.random(raw.shape) < 0.1
    raw[places] = rng.choice(np.array(HOSTILE, np.uint16), int(places.sum()))
    least = min_raw_value(sensor)
    raw[:, 0] = least + np.arange(sensor.height_px) % 3 - 1
    return raw


def calibration_of(sensor: Sensor, *, maps: bool, seed: int = 3) -> RadiometricCalibration:
    rng = np.random.default_rng(seed)
    shape = (sensor.height_px, sensor.width_px)
    neutral = neutral_radiometry(sensor)
    if not maps:
        return replace(neutral, gain=np.full(shape, 1.3, np.float32))
    return replace(
        neutral,
        bias_dn=(64.0 + rng.normal(0.0, 2.0, shape)).astype(np.float32),
        dark_dn_per_s=(20.0 + rng.normal(0.0, 8.0, shape)).astype(np.float32),
        gain=(1.0 + rng.normal(0.0, 0.1, shape)).astype(np.float32),
        defect=(rng.random(shape) < 0.03).astype(np.uint8),
    )


def corrected(
    corrector: Corrector, raw: Array, shifts: int, passes: Any, scale: float
) -> dict[str, Array]:
    out = np.full(raw.shape, 7, np.uint16)
    unclean = unknown_blocks(*raw.shape)
    seen = level1_from_level0(
        corrector,
        raw,
        temperature_c=31.0,
        exposure_time_s=0.02,
        tdi_shifts=shifts,
        out=out,
        scale=scale,
        measure_lines=True,
        unclean=unclean,
        passes=passes,
    )
    figures = [seen.mean_dn, seen.saturated_fraction, seen.unread_fraction or 0.0]
    lines = [] if seen.lines is None else [seen.lines.by_row, seen.lines.by_column]
    return {
        "words": out,
        "unclean": unclean,
        "figures": np.array(figures),
        "lines": np.concatenate([part.ravel() for part in lines] or [np.zeros(0)]),
    }


def radiometry() -> dict[str, Differences]:
    found = {}
    passes = pixel_kernels("cuda").passes
    cases = [
        (maps, height, width, row_sign, shifts, scale)
        for maps in (False, True)
        for height, width, row_sign, shifts, scale in (
            (37, 263, 1, 0, 1.0),
            (71, 67, 1, 5, SUBTLE),
            (67, 33, -1, 3, 0.7),
            (33, 31, 1, 40, 1.0),
            (35, 29, 1, 2, 2e5),
            (34, 29, 1, 0, 1e12),
        )
    ]
    for maps, height, width, row_sign, shifts, scale in cases:
        sensor = sensor_of(height, width, row_sign)
        corrector = corrector_for(sensor, calibration_of(sensor, maps=maps))
        raw = raw_frame(sensor, height, hostile=scale != SUBTLE)
        expected = corrected(corrector, raw, shifts, CPU_PASSES, scale)
        got = corrected(corrector, raw, shifts, passes, scale)
        name = f"{'maps' if maps else 'flat'} {height}x{width} {shifts} shifts"
        found[name] = compared(expected, got)
    return found


def resampling_arguments(cell: int, shape: tuple[int, int], seed: int = 5) -> dict[str, Any]:
    """Three frames that overlap, with holes, saturated pixels, gaps in lattices and seams."""
    rng = np.random.default_rng(seed)
    frames = (2 * rng.integers(1, 32767, (3, 61, 75))).astype(np.uint16)
    marred = rng.random(frames.shape)
    frames[marred < 0.004] = 0
    frames[marred > 0.99] |= 1
    rows, columns = -(-shape[0] // cell) + 1, -(-shape[1] // cell) + 1
    r, c = np.mgrid[0:rows, 0:columns] * float(cell)
    lattices = np.empty((3, rows, columns, 2))
    # Nearly upright, turned by a right angle, and reduced.
    lattices[0] = np.stack([1.003 * c + 0.004 * r - 1.3, 0.998 * r - 0.003 * c + 2.4], axis=-1)
    lattices[1] = np.stack([70.2 - 1.01 * r, 0.99 * c + 1.7], axis=-1)
    lattices[2] = np.stack([0.8 * c + 9.0 + 0.1 * r, 0.85 * r + 3.1], axis=-1)
    lattices[2, -1, 0] = OUTSIDE
    nodes = ((rows - 1) * (cell // 8) + 1, (columns - 1) * (cell // 8) + 1)
    weights = rng.choice(np.array([0, 0, 40, 255], np.uint8), (3, *nodes))
    weights[:, :, : nodes[1] // 3] = 0
    weights[0, :, : nodes[1] // 3] = 255
    return {
        "frames": frames,
        "valid": np.tile(np.array([2.0, 71.999, 2.0, 57.999]), (3, 1)),
        "lattices": lattices,
        "cell_px": cell,
        "weights": weights,
        "gains": np.array([1.0, 1.7, 0.03], np.float32),
        "offsets": np.array([0.0, -900.0, 40.5], np.float32),
    }


def resampled(
    function: Callable[..., None], shape: tuple[int, int], **given: Any
) -> dict[str, Array]:
    out, source = np.full(shape, 7, np.uint16), np.full(shape, 7, np.uint8)
    function(**given, out=out, source=source)
    return {"words": out, "source": source}


def resampling() -> dict[str, Differences]:
    found = {}
    resample_cuda = pixel_kernels("cuda").resample
    cases: list[tuple[int, tuple[int, int], Interpolation]] = [
        (16, (27, 35), interpolation) for interpolation in INTERPOLATIONS
    ]
    cases += [(8, (9, 17), "phase-corrected"), (64, (17, 67), "phase-corrected")]
    for cell, shape, interpolation in cases:
        given = resampling_arguments(cell, shape)
        expected = resampled(resample_fixed, shape, interpolation=interpolation, **given)
        got = resampled(resample_cuda, shape, interpolation=interpolation, **given)
        found[f"{interpolation} {shape[0]}x{shape[1]} cell {cell}"] = compared(expected, got)
    return found


def compared(expected: dict[str, Array], got: dict[str, Array]) -> Differences:
    return {
        name: [int(np.count_nonzero(one != got[name])), int(one.size)]
        for name, one in expected.items()
    }


if __name__ == "__main__":
    print(json.dumps({"radiometry": radiometry, "resampling": resampling}[sys.argv[1]]()))
