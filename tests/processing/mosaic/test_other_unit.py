"""What a rig file of another unit adds to the stated accuracy, by numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from processing.mosaic.layers import LayerChange, LayerCheck
from processing.mosaic.precision import datum_design
from processing.mosaic.validity import RelativeDisplacement
from tests.processing.mosaic.test_precision import mosaic_of
from tests.processing.mosaic.test_uncertainty_contribution import (
    MASTER,
    check,
    displaced_mosaic,
    found,
    validity_of,
)


def one_changed(values: tuple[float, ...], *, several_likely: bool) -> LayerCheck:
    """RGB of a rig with a single master sensor, changed next to a layer within its sigmas."""
    others = (np.array([10.0, 60.0, -80.0, 5.0]), np.array(values))
    return dataclasses.replace(
        check((0.0, 0.0, 0.0, 0.0), changed=True, causes=("RGB",)),
        layers=tuple(
            LayerChange(n, v, np.full(4, 50.0), 1.0)
            for n, v in zip(("1", "RGB"), others, strict=True)
        ),
        several_likely=several_likely,
    )


@pytest.mark.parametrize(
    ("values", "several", "wide"),
    [
        ((-201.0, 0.0, 600.0, 0.0), False, True),
        ((-201.0, -300.0, 0.0, 0.0), False, True),
        ((-199.0, 0.0, 600.0, 0.0), False, False),
        ((-400.0, 199.0, -199.0, 900.0), False, False),
        ((0.0, 0.0, 600.0, 0.0), True, True),
    ],
)
def test_one_cone_whose_lens_and_direction_changed_is_that_of_another_unit(
    values: tuple[float, ...], several: bool, wide: bool
) -> None:
    rig, mosaic = mosaic_of("ultracam-l-mini")
    layers = one_changed(values, several_likely=several)
    datum = found(rig, mosaic, layers=layers).datum
    per_mm = 1e-6 / mosaic.model.pitch_mm
    turn = np.sqrt((60.0**2 + 80.0**2) / 2.0)
    scale = max(np.sqrt((10.0**2 + values[0] ** 2) / 2.0), turn)
    shift = (turn * mosaic.model.f_mm * per_mm) ** 2
    expected = np.diag([shift, shift, (scale * per_mm) ** 2, 0.0]) * wide
    np.testing.assert_allclose(datum, expected, rtol=1e-9, atol=1e-15)
    # Several master sensors are compared with each other.
    rig, mosaic = mosaic_of("ultracam-x-mini")
    others = tuple(dataclasses.replace(layer, cone="2") for layer in layers.layers)
    of_several = dataclasses.replace(layers, causes=("2",), layers=others)
    assert not found(rig, mosaic, layers=of_several).datum.any()


def relative(cone: str, a: str, b: str, dx_px: float, dy_px: float) -> RelativeDisplacement:
    return RelativeDisplacement(cone, a, b, dx_px, dy_px, 0.1, 0.1, 90.0, 10.0)


def test_places_of_another_unit_are_off_by_what_all_cones_show() -> None:
    moved_px = {"SU00": (0.5, -0.2), "SU03": (0.1, 0.4), "SU01": (-0.3, 0.2)}
    rig, mosaic = displaced_mosaic(moved_px)
    first = [mosaic.model.sensors[name] for name in MASTER]
    left = np.array([mosaic.values[i : i + 2] for i in first]) / mosaic.model.pitch_mm
    apart = (relative("1", "SU10", "SU11", 0.6, -0.8), relative("2", "SU20", "SU21", 0.3, 0.4))
    validity = dataclasses.replace(validity_of("SU00", several=True), relative=apart)
    # 4 of master sensors, 2 each of the others; the variance of another place, by Student's t.
    variance = (np.sum(left**2) + 1.0 / 2.0 + 0.25 / 2.0) / (8.0 - 2.0)
    unit = check((0.0, 0.0, 0.0, 0.0), changed=True, causes=("1", "2"))
    unit = dataclasses.replace(unit, layers=(LayerChange("1", np.zeros(4), np.ones(4), 1.0),))
    every = found(rig, mosaic, validity=validity, layers=unit)
    # A shift is the mean over four sensors.
    np.testing.assert_allclose(np.diag(every.datum)[:2], variance / 4.0, rtol=1e-2)
    assert not every.parts
    resting = found(rig, mosaic, validity=validity, layers=unit, weak=("SU30",))
    np.testing.assert_array_equal(resting.datum, every.datum)
    sizes = [np.abs(part.unknowns / mosaic.model.units).max() for part in resting.parts]
    assert sizes == pytest.approx([np.sqrt(variance)] * len(sizes)) and sizes
    # Layers as calibrated: any two sensors may be in place, and what rests on calibration is off.
    alone = found(rig, mosaic, validity=validity, weak=("SU30",))
    assert len(alone.parts) == len(sizes) and not np.allclose(alone.datum, every.datum)
    one = dataclasses.replace(validity, several_displaced=False, global_statistic=19.0)
    assert not found(rig, mosaic, validity=one, layers=unit, weak=("SU30",)).parts


def test_places_of_master_sensors_alone_show_another_unit_too() -> None:
    rig, mosaic = displaced_mosaic({"SU00": (0.5, -0.2), "SU03": (0.1, 0.4)})
    mosaic = dataclasses.replace(mosaic, undetermined=("SU03.x", "SU03.y"))
    first = [mosaic.model.sensors[name] for name in MASTER[:3]]
    moved = np.array([mosaic.values[i : i + 2] for i in first]).reshape(-1)
    moved = moved / mosaic.model.pitch_mm
    design = datum_design(np.array([[s.x_mm, s.y_mm] for s in rig.master_sensors[:3]]))
    left = moved - design @ np.linalg.lstsq(design, moved, rcond=None)[0]
    some = found(rig, mosaic, validity=validity_of("SU00", several=True))
    of_sensor = [part for part in some.parts if np.flatnonzero(part.unknowns)[0] < 16]
    size = np.abs(of_sensor[0].unknowns / mosaic.model.units).max()
    # Two degrees of freedom are too few for a variance: their sum stands for it.
    assert size == pytest.approx(np.sqrt(np.sum(left**2)), rel=1e-6)
