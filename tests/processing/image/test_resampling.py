"""Resampling: where pixels are fetched, and what comes out, against formulas written again here."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements, raw_from_vip_mm, vip_mm_from_px
from processing.image.composition import COLOUR_CELL_PX, PAN_CELL_PX
from processing.image.kernels import INTERPOLATIONS, Interpolation
from processing.image.lattice import (
    OUTSIDE,
    colour_raster,
    fill_lattice,
    interpolate_lattice,
    lattice_shape,
    pan_raster,
)
from processing.image.resampling import (
    SATURATED_SOURCE,
    WEIGHT_STEP_PX,
    WEIGHT_UNIT,
    resample,
)
from processing.rig import find_rig

CELL = 16


@pytest.mark.parametrize("name", ["ultracam-x-mini", "ultracam-x"])
@pytest.mark.parametrize("sensor", ["SU00", "SU11", "SU21", "SU30", "G", "N"])
def test_the_lattice_is_exact_to_five_thousandths_of_a_pixel(name: str, sensor: str) -> None:
    rig = find_rig(name)
    image = rig.virtual_image
    assert image is not None
    placement = nominal_placements(rig, dict.fromkeys(rig.probes, 40.0), {})[sensor]
    pan = rig.cone_of(sensor).role == "pan"
    raster, cell = (
        (pan_raster(image), PAN_CELL_PX) if pan else (colour_raster(image), COLOUR_CELL_PX)
    )
    lattice = np.empty((*lattice_shape(raster, cell), 2))
    fill_lattice(image, raster, placement, cell, lattice)
    rng = np.random.default_rng(1)
    target = rng.uniform(0, 1, (40_000, 2)) * [raster.width_px - 1, raster.height_px - 1]
    found = interpolate_lattice(lattice, cell, target)
    vip = target * raster.ratio + (raster.ratio - 1) / 2
    exact = raw_from_vip_mm(placement, vip_mm_from_px(image, vip))
    width, height = placement.sensor.width_px, placement.sensor.height_px
    seen = ((exact > 0) & (exact < [width - 1, height - 1])).all(axis=1)
    assert seen.sum() > 3000
    assert np.isfinite(found[seen]).all()
    assert np.abs(found - exact)[seen].max() < 0.005


def catmull_rom(frame: NDArray[np.float64], c: float, r: float) -> float:
    """Keys' cubic convolution, a = -1/2, from its definition."""

    def weight(x: float) -> float:
        x = abs(x)
        if x < 1:
            return 1.5 * x**3 - 2.5 * x**2 + 1
        return -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2 if x < 2 else 0.0

    i, j = int(np.floor(r)), int(np.floor(c))
    return sum(
        weight(r - y) * weight(c - x) * frame[y, x]
        for y in range(i - 1, i + 3)
        for x in range(j - 1, j + 3)
    )


def fetch(
    frames: NDArray[np.uint16],
    matrices: list[tuple[float, float, float, float, float, float]],
    *,
    interpolation: Interpolation = "cubic",
    shape: tuple[int, int] = (96, 128),
    gains: list[float] | None = None,
    offsets: list[float] | None = None,
    weights: NDArray[np.uint8] | None = None,
    cell: int = CELL,
) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Resample with raw = (c0 + cx x + cy y, r0 + rx x + ry y) for each frame."""
    count, height, width = frames.shape
    rows, columns = shape[0] // cell + 1, shape[1] // cell + 1
    x, y = np.meshgrid(np.arange(columns) * cell, np.arange(rows) * cell)
    lattices = np.empty((count, rows, columns, 2))
    for k, (c0, cx, cy, r0, rx, ry) in enumerate(matrices):
        lattices[k, ..., 0] = c0 + cx * x + cy * y
        lattices[k, ..., 1] = r0 + rx * x + ry * y
    if weights is None:
        per_cell = cell // WEIGHT_STEP_PX
        nodes = ((rows - 1) * per_cell + 1, (columns - 1) * per_cell + 1)
        weights = np.full((count, *nodes), WEIGHT_UNIT, np.uint8)
    valid = np.tile([2.0, width - 3.001, 2.0, height - 3.001], (count, 1))
    out, source = np.full(shape, 77, np.uint16), np.full(shape, 77, np.uint8)
    resample(
        frames,
        valid,
        lattices,
        cell,
        weights,
        np.array(gains or [1.0] * count, np.float32),
        offsets=None if offsets is None else np.array(offsets, np.float32),
        interpolation=interpolation,
        out=out,
        source=source,
    )
    return out, source


@pytest.mark.parametrize(
    "matrix",
    [
        (5.3, 1.0, 0.0, 6.6, 0.0, 1.0),
        (5.9, 1.0009, -0.0004, 6.99, 0.0005, 0.9988),
        (9.1, 0.93, 0.05, 6.2, -0.02, 1.04),
    ],
)
def test_cubic_is_the_textbook_kernel_also_where_runs_cross_a_tap(
    matrix: tuple[float, float, float, float, float, float],
) -> None:
    rng = np.random.default_rng(4)
    # Smooth as a lens leaves it: neighbours correlate, nothing jumps from 0 to full scale.
    frame = 9000 + 6000 * np.sin(np.indices((130, 170)).sum(axis=0) / 3.1)
    frame = ((frame + rng.normal(0, 200, frame.shape)) // 2 * 2).astype(np.uint16)
    out, source = fetch(frame[None], [matrix])
    c0, cx, cy, r0, rx, ry = matrix
    checked = 0
    for y, x in rng.integers(0, [96, 128], (600, 2)):
        c, r = c0 + cx * x + cy * y, r0 + rx * x + ry * y
        if not (2 <= c <= 166.9 and 2 <= r <= 126.9):
            assert source[y, x] == 0 and out[y, x] == 0
            continue
        checked += 1
        assert out[y, x] == pytest.approx(catmull_rom(frame.astype(float), c, r), abs=4.0)
        assert source[y, x] == 1
    assert checked > 450


@pytest.mark.parametrize(
    "matrix",
    [
        (40.3, 1.0004, -0.0003, 41.6, 0.0004, 0.9997),
        (40.5, 0.9995, 0.0002, 41.5, -0.0005, 1.0003),
        (40.97, 1.0005, 0.0004, 41.02, -0.0004, 0.9996),
    ],
)
@pytest.mark.parametrize("cell", [32, 64])
def test_two_passes_in_cells_of_the_product_are_the_textbook_kernel_to_an_eighth_of_a_dn(
    matrix: tuple[float, float, float, float, float, float], cell: int
) -> None:
    rng = np.random.default_rng(8)
    y, x = np.indices((280, 350))
    # Detail down to five pixels a wave, as far as a lens carries it, and shot noise over it.
    ground = 9000 + 3000 * np.sin(x / 0.8) * np.cos(y / 0.9) + 3000 * np.sin((x + 2 * y) / 7.0)
    frame = (np.clip(ground + rng.normal(0, 60, ground.shape), 2, 65000) // 2 * 2).astype(np.uint16)
    out, source = fetch(frame[None], [matrix], shape=(192, 256), cell=cell)
    assert np.all(source == 1)
    c0, cx, cy, r0, rx, ry = matrix
    off = [
        out[y, x] - catmull_rom(frame.astype(float), c0 + cx * x + cy * y, r0 + rx * x + ry * y)
        for y, x in rng.integers(0, [192, 256], (800, 2))
    ]
    # Eight counts to the DN; rounding alone leaves 0.29. Next to the joints taps are shared over
    # 0.02 px, and rows in the first pass lean by their slope.
    assert np.sqrt(np.mean(np.square(off))) < 1.0
    assert np.abs(np.mean(off)) < 0.1
    assert np.max(np.abs(off)) < 8.0


@pytest.mark.parametrize(
    ("interpolation", "error"),
    [("bilinear", 0.07), ("cubic", 0.012), ("lanczos", 0.008), ("phase-corrected", 0.05)],
)
def test_each_interpolation_follows_a_wave_of_eight_pixels(
    interpolation: Interpolation, error: float
) -> None:
    y, x = np.indices((130, 170))
    frame = np.rint(10000 + 8000 * np.sin(2 * np.pi * x / 8) * np.cos(2 * np.pi * y / 9))
    frame = (frame // 2 * 2).astype(np.uint16)
    out, _ = fetch(frame[None], [(6.37, 1.0, 0.0, 7.61, 0.0, 1.0)], interpolation=interpolation)
    y, x = np.indices(out.shape)
    truth = np.sin(2 * np.pi * (x + 6.37) / 8) * np.cos(2 * np.pi * (y + 7.61) / 9)
    off = (out - 10000.0) / 8000 - truth
    assert np.sqrt(np.mean(off**2)) < error


def test_gain_is_applied_once_and_rounding_is_to_the_nearest() -> None:
    frame = np.full((1, 130, 170), 10000, np.uint16)
    out, _ = fetch(frame, [(6.4, 1.0, 0.0, 7.6, 0.0, 1.0)], gains=[1.23456])
    assert np.all(out == 12346)


def test_an_offset_is_added_after_the_gain_wherever_a_frame_serves() -> None:
    frames = np.full((2, 130, 170), 10000, np.uint16)
    matrices = [(6.4, 1.0, 0.0, 7.6, 0.0, 1.0), (8.4, 1.0, 0.0, 9.6, 0.0, 1.0)]
    for interpolation in INTERPOLATIONS:
        out, _ = fetch(
            frames[:1], matrices[:1], gains=[1.2], offsets=[-25.4], interpolation=interpolation
        )
        assert np.all(out == 11975)
    out, _ = fetch(frames, matrices, gains=[1.2, 1.0], offsets=[-25.0, 5.0])
    assert np.all(out == 10990)


@pytest.mark.parametrize(
    ("interpolation", "reach"),
    [("bilinear", 0), ("cubic", 1), ("lanczos", 2), ("phase-corrected", 2)],
)
def test_saturated_pixels_and_holes_reach_the_image_as_such(
    interpolation: Interpolation, reach: int
) -> None:
    frame = np.full((1, 130, 170), 5000, np.uint16)
    frame[0, 40, 50] |= 1
    frame[0, 80, 90] = 0
    out, source = fetch(frame, [(5.0, 1.0, 0.0, 6.0, 0.0, 1.0)], interpolation=interpolation)
    saturated = np.argwhere(source & SATURATED_SOURCE)
    assert {tuple(p) for p in saturated} == {(33, 44), (33, 45), (34, 44), (34, 45)}
    holes = np.argwhere(source == 0)
    assert {tuple(p) for p in holes} == {
        (y, x) for y in range(73 - reach, 75 + reach) for x in range(84 - reach, 86 + reach)
    }
    assert np.all(out[source == 0] == 0) and np.all(out[source != 0] >= 4999)


def test_frames_blend_by_their_weights_and_a_missing_one_leaves_all_to_the_other() -> None:
    frames = np.stack([np.full((130, 170), 4000), np.full((130, 170), 8000)]).astype(np.uint16)
    place = (5.0, 1.0, 0.0, 6.0, 0.0, 1.0)
    weights = np.zeros((2, 13, 17), np.uint8)
    weights[0, :, :8], weights[1, :, 8:] = WEIGHT_UNIT, WEIGHT_UNIT
    out, source = fetch(frames, [place, place], weights=weights)
    assert np.all(out[:, :56] == 4000) and np.all(out[:, 64:] == 8000)
    assert np.array_equal(out[10, 56:64], 4000 + 500 * np.arange(8))
    assert set(np.unique(source)) == {1, 2} and np.all(source[:, :60] == 1)
    # The second frame ends at its own column 60: what lies beyond is the first frame's.
    out, source = fetch(frames, [place, (110.5, 1.0, 0.0, 6.0, 0.0, 1.0)], weights=weights)
    assert np.all(source[:, :56] == 1) and np.all(source[:, 57:64] == 1)
    assert np.all(source[:, 64:] == 0)


@pytest.mark.parametrize(("cell", "shape"), [(64, (128, 192)), (32, (96, 128)), (CELL, (96, 112))])
def test_what_frames_share_is_the_weighted_mean_of_what_each_gives_alone(
    cell: int, shape: tuple[int, int]
) -> None:
    frames = (np.random.default_rng(4).integers(2500, 4500, (2, 260, 300)) * 2).astype(np.uint16)
    matrices = [(6.4, 1.0002, 0.0003, 7.6, -0.0004, 0.9999), (9.3, 0.9998, 0.0001, 12.2, 0.0, 1.0)]
    alone = [fetch(frames[[k]], [matrices[k]], shape=shape, cell=cell)[0] for k in (0, 1)]
    nodes = tuple(-(-pixels // cell) * cell // WEIGHT_STEP_PX + 1 for pixels in shape)
    weights = np.stack([np.full(nodes, 200, np.uint8), np.full(nodes, 50, np.uint8)])
    shared, source = fetch(frames, matrices, shape=shape, weights=weights, cell=cell)
    expected = (200.0 * alone[0] + 50.0 * alone[1]) / 250.0
    assert np.abs(shared - expected).max() <= 1.0
    assert np.all(source == 1)


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    import numba

    frames = (np.random.default_rng(1).integers(1, 8000, (1, 130, 170)) * 2).astype(np.uint16)
    before = numba.get_num_threads()
    try:
        results = []
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            results.append(fetch(frames, [(5.9, 1.0009, -0.0004, 6.99, 0.0005, 0.9988)])[0])
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(results[0], results[1])


def test_a_sensor_far_away_is_outside_of_every_node() -> None:
    rig = find_rig("ultracam-x-mini")
    image = rig.virtual_image
    assert image is not None
    lattice = np.zeros((*lattice_shape(pan_raster(image), 32), 2))
    fill_lattice(image, pan_raster(image), nominal_placements(rig, {}, {})["SU00"], 32, lattice)
    assert np.all(lattice[-1, -1] == OUTSIDE)
    assert np.mean(lattice[..., 0] == OUTSIDE) > 0.75


@pytest.mark.parametrize(("cell", "beyond"), [(64, 76), (32, 44)])
def test_columns_computed_beyond_the_taps_do_not_reach_the_image(cell: int, beyond: int) -> None:
    rng = np.random.default_rng(12)
    frame = (rng.integers(2000, 20000, (cell + 16, 200)) // 2 * 2).astype(np.uint16)
    changed = frame.copy()
    changed[:, beyond:] = 65534
    matrix = (5.3, 1.0009, 0.0, 6.4, 0.0005, 1.0)
    images = [
        fetch(given[None], [matrix], interpolation="phase-corrected", shape=(cell, cell), cell=cell)
        for given in (frame, changed, frame[:, :beyond].copy())
    ]
    for out, source in images[1:]:
        assert np.array_equal(out, images[0][0])
        assert np.array_equal(source, images[0][1])
    assert np.all(images[0][1] == 1)
