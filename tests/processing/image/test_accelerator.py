"""Kernels for an accelerator have the bits of the processor; a device that is not there is refused.

The kernels run in numba's simulator, in a process of their own. Where the CUDA toolkit is
installed, they are compiled for a device as well, which needs none.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.image.accelerator import devices
from processing.image.accelerator.devices import DEVICES, AcceleratorError, why_unusable
from processing.image.accelerator.fixed_resampling import (
    WEIGHT_BITS,
    fixed_table,
    resample_fixed,
)
from processing.image.accelerator.pixel_kernels import pixel_kernels
from processing.image.kernels import (
    INTERPOLATIONS,
    KERNELS,
    MARGIN,
    Interpolation,
    phase_corrected_weights,
)
from processing.image.resampling import SATURATED_SOURCE, resample
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings
from processing.quality.report import as_json
from processing.radiometry.level1 import CPU_PASSES
from processing.rig import find_rig
from tests.processing.image.simulated_accelerator import resampled, resampling_arguments
from tests.processing.synthetic_exposure import expose

COMPILED = """
import json
import numba.cuda.dispatcher as dispatcher
from numba import cuda, types as t

class Device:
    compute_capability = (8, 7)

# numba asks a device only for what it can do.
dispatcher.get_current_device = lambda: Device
from processing.image.accelerator import cuda_radiometry as radiometry, cuda_resampling

words, small, real, whole = t.uint16[:, ::1], t.uint8[:, ::1], t.float32, t.int64
stack, sums = t.uint8[:, :, ::1], t.int64[::1]
signatures = {
    radiometry._correct_flat: (
        words, real, real, whole, whole, whole, words, sums, small),
    radiometry._correct_maps: (
        words, small, small, words, real, real, real, real, whole, whole, whole, whole, whole,
        words, sums, small),
    radiometry._sum_rows: (words, whole, t.uint32[:, ::1]),
    radiometry._sum_columns: (words, whole, t.uint32[:, ::1]),
    cuda_resampling._resample: (
        t.uint16[:, :, ::1], t.int64[:, ::1], t.int64[:, :, :, ::1], stack, stack, sums, sums,
        t.int32[:, ::1], whole, whole, words, small),
}
print(json.dumps({
    kernel.py_func.__name__: cuda.compile_ptx(kernel.py_func, types, cc=(8, 7))[0]
    for kernel, types in signatures.items()
}))
"""
"""Prints the instructions of every kernel for an Orin (compute capability 8.7)."""


@pytest.mark.parametrize("case", ["radiometry", "resampling"])
def test_simulated_kernels_have_the_bits_of_the_processor(case: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.processing.image.simulated_accelerator", case],
        env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        timeout=110,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found) >= 6
    for name, results in found.items():
        assert results["words"][1] > 100, name
        assert {what: differ for what, (differ, _) in results.items() if differ} == {}, name


def test_instructions_for_a_device_round_once_each_and_fuse_only_what_the_processor_fuses() -> None:
    done = subprocess.run(
        [sys.executable, "-c", COMPILED], capture_output=True, text=True, timeout=110
    )
    if "NvvmSupportError" in done.stderr:
        pytest.skip("needs libnvvm of the CUDA toolkit")
    assert done.returncode == 0, done.stderr
    fused = {}
    for name, text in json.loads(done.stdout).items():
        steps = re.findall(r"\b(?:add|sub|mul|div|fma|mad|rcp|sqrt)\S*\.f(?:32|64)", text)
        assert set(steps) <= {"sub.rn.f32", "div.rn.f32", "fma.rn.f32"}, name
        fused[name] = "fma.rn.f32" in steps
    assert fused == {
        "_correct_flat": True,
        "_correct_maps": True,
        "_sum_rows": False,
        "_sum_columns": False,
        "_resample": False,
    }


@pytest.mark.parametrize("maps", [False, True])
def test_the_processor_fuses_the_products_that_the_kernels_for_a_device_fuse(maps: bool) -> None:
    """With maps, and just above black, a product that is rounded by itself makes other words."""
    rng = np.random.default_rng(1)
    shape = (900, 1000)
    raw = rng.integers(64, 140, shape).astype(np.uint16)
    words, sums = np.zeros(shape, np.uint16), np.zeros((1, 3), np.int64)
    by_row, by_column = np.zeros((900, 0), np.uint32), np.zeros((1, 0), np.uint32)
    end = (4095, 0, 0, words, sums, by_row, by_column, np.zeros((0, 0), np.uint8))
    base, factor, unit, dark_unit = np.float32([61.3, 420.7, 0.0173, 0.0031])
    bias, dark = rng.integers(0, 255, (2, *shape)).astype(np.uint8)
    response = rng.integers(12000, 20000, shape).astype(np.uint16)
    if maps:
        factor *= np.float32(16384.0)
        CPU_PASSES.maps(*(raw, bias, dark, response, unit, dark_unit, base, factor, 0, 0), *end)
    else:
        CPU_PASSES.flat(raw, base, factor, *end)

    def expected(fused: Callable[[Any, Any, Any], Any]) -> NDArray[Any]:
        offset, gain = np.full(shape, base), np.full(shape, factor)
        if maps:
            offset = fused(bias, unit, base)
            offset = fused(dark, dark_unit, offset)
            gain = factor / response.astype(np.float32)
        signal = fused(raw.astype(np.float32) - offset, gain, np.float32(0.5))
        return np.clip(signal.astype(np.int32), 1, 32767)

    def once(a: Any, b: Any, c: Any) -> Any:
        return (np.float64(a) * np.float64(b) + np.float64(c)).astype(np.float32)

    def twice(a: Any, b: Any, c: Any) -> Any:
        return np.float32(a) * np.float32(b) + c

    assert np.array_equal(words // 2, expected(once))
    assert np.array_equal(words // 2, expected(twice)) == (not maps)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_weights_sum_to_one_exactly_and_are_those_of_the_table(
    interpolation: Interpolation,
) -> None:
    fixed = fixed_table(interpolation)
    assert (fixed.sum(axis=1, dtype=np.int64) == 1 << WEIGHT_BITS).all()
    at_table = KERNELS[interpolation].table[MARGIN:-MARGIN, :6]
    steps = (len(fixed) - 1) // (len(at_table) - 1)
    assert np.abs(fixed[::steps] / (1 << WEIGHT_BITS) - at_table).max() < 3e-6


@pytest.mark.parametrize("word", [2, 1000, 65534])
def test_an_even_frame_stays_even_with_its_gain_and_offset(word: int) -> None:
    given = one_frame(np.full((61, 75), word, np.uint16))
    found = resampled(resample_fixed, (30, 40), interpolation="phase-corrected", **given)
    assert set(np.unique(found["words"][6:, 6:])) == {word}
    given |= {"gains": np.array([0.5], np.float32), "offsets": np.array([3.0], np.float32)}
    found = resampled(resample_fixed, (30, 40), interpolation="phase-corrected", **given)
    assert set(np.unique(found["words"][6:, 6:])) == {word // 2 + 3}


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_integers_and_floating_point_fetch_the_same_pixels(interpolation: Interpolation) -> None:
    row, column = np.mgrid[0:61, 0:75]
    scene = 9000.0 + 3000.0 * np.sin(row / 3.0) * np.cos(column / 4.0)
    frame = 2 * (scene / 2.0).astype(np.uint16)
    frame[20, 30] = 0
    frame[40, 50] |= 1
    given = one_frame(frame)
    fixed = resampled(resample_fixed, (45, 51), interpolation=interpolation, **given)
    floating = resampled(resample, (45, 51), interpolation=interpolation, **given)
    assert (fixed["source"] == floating["source"]).all()
    assert (fixed["source"] & SATURATED_SOURCE).any() and (fixed["source"] == 0).any()
    off = np.abs(fixed["words"].astype(int) - floating["words"])
    assert off.max() <= (8 if interpolation == "phase-corrected" else 1)
    assert off.mean() < 0.3


def test_integers_are_within_one_count_of_the_exact_value_at_joints_of_taps_too() -> None:
    row, column = np.mgrid[0:61, 0:75]
    scene = 9000.0 + 3000.0 * np.sin(row / 2.0) * np.cos(column / 3.0)
    given = one_frame(scene.astype(np.uint16))
    shape, cell = (45, 51), given["cell_px"]
    given["gains"] = np.array([1.25], np.float32)
    given["valid"] = np.array([[2.0, 40.0, 2.0, 35.0]])
    found = resampled(resample_fixed, shape, interpolation="phase-corrected", **given)
    # Lattices of `resampling_arguments` are affine: their formula serves every pixel.
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    c, r = 1.003 * x + 0.004 * y - 1.3, 0.998 * y - 0.003 * x + 2.4
    inside = (c >= 2.0) & (c <= 40.0) & (r >= 2.0) & (r <= 35.0)
    left, top = np.floor(c).astype(int).clip(2, 71), np.floor(r).astype(int).clip(2, 57)
    along = phase_corrected_weights((c - left).ravel()).reshape(*shape, 6)
    down = phase_corrected_weights((r - top).ravel()).reshape(*shape, 6)
    taps = np.arange(-2, 4)
    words = given["frames"][0][
        top[..., None, None] + taps[:, None], left[..., None, None] + taps
    ].astype(np.float64)
    exact = 1.25 * np.einsum("yxi,yxj,yxij->yx", down, along, words)
    assert cell == 16 and inside.mean() > 0.5
    assert np.array_equal(found["words"] > 0, inside)
    assert np.abs(found["words"] - exact)[inside].max() < 1.0
    assert abs(np.mean((found["words"] - exact)[inside])) < 0.02


def test_frames_that_share_pixels_are_blended_as_in_floating_point() -> None:
    given = resampling_arguments(16, (45, 51))
    given["frames"] = 2 * (given["frames"] // 64 + 4000)
    fixed = resampled(resample_fixed, (45, 51), interpolation="cubic", **given)
    floating = resampled(resample, (45, 51), interpolation="cubic", **given)
    same = fixed["source"] == floating["source"]
    assert same.mean() > 0.99
    off = np.abs(fixed["words"].astype(int) - floating["words"])[same]
    assert np.median(off) == 0 and np.quantile(off, 0.99) <= 4


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"cell_px": 24}, "cell of 24 px; in integers it is 8, 16, 32 or 64"),
        ({"gains": np.array([np.inf], np.float32)}, "in integers it is below 1024"),
        ({"gains": np.array([np.nan], np.float32)}, "in integers it is below 1024"),
        ({"offsets": np.array([1e9], np.float32)}, "in integers it is below"),
        ({"valid": np.array([[2.0, np.nan, 2.0, 57.0]])}, "its four numbers are finite"),
        ({"lattices": np.zeros((1, 3, 4, 2))}, "do not cover"),
        ({"weights": np.zeros((1, 7, 8), np.uint8)}, "do not cover"),
    ],
)
def test_what_integers_cannot_hold_is_refused(changed: dict[str, Any], sentence: str) -> None:
    given = one_frame(np.full((61, 75), 1000, np.uint16)) | changed
    with pytest.raises(ValueError, match=sentence):
        resampled(resample_fixed, (45, 51), interpolation="cubic", **given)


def test_taps_never_leave_the_frame_whatever_area_is_called_usable() -> None:
    given = one_frame(np.full((61, 75), 1000, np.uint16))
    given["valid"] = np.array([[-1e9, 1e9, -1e9, 1e9]])
    given["lattices"] = given["lattices"] * 3.0 - 60.0
    given["lattices"][0, 0, 0] = np.nan
    given["lattices"][0, 1, 3] = 1e300
    found = resampled(resample_fixed, (45, 51), interpolation="lanczos", **given)
    assert set(np.unique(found["words"])) == {0, 1000}


def test_a_device_that_is_not_there_is_refused_with_the_cure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(devices, "_cuda_fault", lambda: "no such device can be used (no driver)")
    sentence = why_unusable("cuda")
    assert sentence is not None
    assert "no driver" in sentence and 'set device = "cpu"' in sentence
    with pytest.raises(AcceleratorError, match="no such device"):
        pixel_kernels("cuda")
    with pytest.raises(AcceleratorError, match="no such device"):
        Pipeline(find_rig("ultracam-x-mini"), {}, PipelineSettings(device="cuda"))
    assert why_unusable("cpu") is why_unusable("cuda-reference") is None


def test_the_reason_of_the_driver_is_in_the_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    from numba import cuda

    monkeypatch.setattr(cuda, "is_available", lambda: False)
    monkeypatch.setattr(cuda, "cuda_error", lambda: "\nCUDA driver library cannot be found.\nIf")
    assert "(CUDA driver library cannot be found)" in str(why_unusable("cuda"))


@pytest.mark.timeout(300)
def test_pixels_in_integers_leave_the_report_as_it_is() -> None:
    rig = find_rig("ultracam-x-mini")
    exposure = expose(rig)
    conditions = Conditions(
        temperatures_c=exposure.temperatures_c,
        exposure_time_s={sensor.name: 0.004 for sensor in rig.sensors},
        tdi_shifts=exposure.tdi_shifts,
        simulated=True,
    )
    found = []
    for device in DEVICES[::2]:
        pipeline = Pipeline(rig, {}, PipelineSettings(geometry=False, device=device))
        product = pipeline.process(exposure.frames, conditions)
        found.append((product.pan, product.valid, numbers_of(as_json(product.report))))
    (pan, source, report), (fixed, fixed_source, fixed_report) = found
    off = pan.astype(int) - fixed
    # A fifth of the read noise, 12 counts.
    assert 0.0 < off.std() < 3.0 and abs(off.mean()) < 0.01
    assert np.mean(source != fixed_source) < 1e-4
    assert fixed_report.keys() == report.keys()
    for name, value in report.items():
        is_number = isinstance(value, int | float)
        assert fixed_report[name] == (pytest.approx(value, rel=1e-6) if is_number else value), name


def numbers_of(content: Any, name: str = "") -> dict[str, Any]:
    """Every number and text of nested JSON by its path."""
    if isinstance(content, dict | list):
        items = content.items() if isinstance(content, dict) else enumerate(content)
        return {k: v for key, one in items for k, v in numbers_of(one, f"{name}/{key}").items()}
    return {name: content}


def one_frame(frame: NDArray[np.uint16]) -> dict[str, Any]:
    """The first frame of `resampling_arguments` alone, nearly upright."""
    given = resampling_arguments(16, (45, 51))
    return given | {
        "frames": frame[None],
        "valid": given["valid"][:1],
        "lattices": given["lattices"][:1].copy(),
        "weights": np.full_like(given["weights"][:1], 255),
        "gains": np.ones(1, np.float32),
        "offsets": np.zeros(1, np.float32),
    }
