"""Marks of blocks with saturated pixels and holes: exact, and without effect on the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.image.composition import PanComposer
from processing.image.resampling import WEIGHT_STEP_PX, WEIGHT_UNIT, resample
from processing.radiometry.calibration import neutral_radiometry
from processing.radiometry.corrector import corrector_for
from processing.radiometry.level1 import level1_from_level0
from processing.radiometry.unclean_blocks import BLOCK_PX, unknown_blocks
from processing.rig import find_rig


@pytest.mark.parametrize("with_maps", [False, True])
@pytest.mark.parametrize(("shifts", "sign"), [(0, 1), (5, 1), (5, -1)])
def test_the_pass_marks_the_blocks_of_every_saturated_pixel_and_hole(
    shifts: int, sign: int, with_maps: bool
) -> None:
    rng = np.random.default_rng(3)
    height, width = 6 * BLOCK_PX + 20, 5 * BLOCK_PX + 8
    sensor = replace(
        find_rig("ultracam-x-mini").sensor("SU00"),
        width_px=width,
        height_px=height,
        tdi_row_sign=sign,
    )
    gain = np.full((height, width), 1.0, np.float32)
    if with_maps:
        gain += rng.uniform(0.0, 0.1, gain.shape).astype(np.float32)
    defect = np.zeros((height, width), np.uint8)
    defect[200:222, 140:162] = 1  # wider than the reach of the interpolation: holes stay
    defect[300, 20] = 1
    calibration = replace(neutral_radiometry(sensor), gain=gain, defect=defect)
    raw = rng.integers(200, 3000, (height, width)).astype(np.uint16)
    raw[100, 300] = raw[height - 30, 7] = sensor.full_scale_dn
    out, unclean = np.zeros(raw.shape, np.uint16), unknown_blocks(height, width)
    level1_from_level0(
        corrector_for(sensor, calibration),
        raw,
        temperature_c=20.0,
        exposure_time_s=0.002,
        tdi_shifts=shifts,
        out=out,
        unclean=unclean,
    )
    seen = (out == 0) | (out % 2 == 1)
    expected = [
        [
            seen[r * BLOCK_PX : (r + 1) * BLOCK_PX, c * BLOCK_PX : (c + 1) * BLOCK_PX].any()
            for c in range(unclean.shape[1])
        ]
        for r in range(unclean.shape[0])
    ]
    assert 3 <= np.count_nonzero(expected) < unclean.size // 2
    assert unclean.tolist() == np.array(expected, np.uint8).tolist()


def test_marked_blocks_give_the_image_of_a_look_at_every_pixel() -> None:
    rng = np.random.default_rng(5)
    frame = (rng.integers(2000, 20000, (5 * BLOCK_PX, 6 * BLOCK_PX)) // 2 * 2).astype(np.uint16)
    # Just inside and just outside the taps of cells, a saturated pixel and a hole.
    frame[64, 128] |= 1
    frame[191, 66] = 0
    frame[250:254, 300] = 1
    cell, shape = 64, (256, 320)
    x, y = np.meshgrid(np.arange(0, 321, cell), np.arange(0, 257, cell))
    lattice = np.stack([5.3 + 1.0004 * x, 6.4 + 0.0003 * x + 1.0 * y], axis=-1)
    nodes = (256 // WEIGHT_STEP_PX + 1, 320 // WEIGHT_STEP_PX + 1)
    marks = np.zeros((1, 5, 6), np.uint8)
    for row, column in np.argwhere((frame == 0) | (frame % 2 == 1)):
        marks[0, row // BLOCK_PX, column // BLOCK_PX] = 1
    assert 0 < np.count_nonzero(marks) < marks.size // 2
    images = []
    for unclean in (None, marks):
        out, source = np.zeros(shape, np.uint16), np.zeros(shape, np.uint8)
        resample(
            frame[None],
            np.array([[2.0, 6 * BLOCK_PX - 3.001, 2.0, 5 * BLOCK_PX - 3.001]]),
            lattice[None],
            cell,
            np.full((1, *nodes), WEIGHT_UNIT, np.uint8),
            np.ones(1, np.float32),
            interpolation="phase-corrected",
            out=out,
            source=source,
            unclean=unclean,
        )
        images.append((out, source))
    assert np.array_equal(images[0][0], images[1][0])
    assert np.array_equal(images[0][1], images[1][1])
    assert np.any(images[0][1] == 0x81) and np.any(images[0][1] == 0)


def test_a_frame_of_which_nothing_is_known_is_marked_throughout() -> None:
    rig = find_rig("ultracam-x-mini")
    assert rig.virtual_image is not None
    sensors = [sensor for cone in rig.pan_cones for sensor in cone.sensors]
    composer = PanComposer(rig.virtual_image, sensors)
    marks = composer.unclean(sensors[0].name)
    assert marks.shape == unknown_blocks(sensors[0].height_px, sensors[0].width_px).shape
    assert marks.all()
