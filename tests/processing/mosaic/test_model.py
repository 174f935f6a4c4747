"""Derivatives of the model of a mosaic against differences, and the layout of its unknowns."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from processing.geometry.placement import corrected_mm_from_raw, nominal_placements
from processing.mosaic.model import build_model, placement_at, vip_and_design
from processing.rig import find_rig
from tests.processing.synthetic import mosaic_model_of

X_MINI, DMC = find_rig("ultracam-x-mini"), find_rig("dmc-mini")


@pytest.mark.parametrize(("rig", "name"), [(X_MINI, "SU00"), (X_MINI, "SU11"), (DMC, "P2")])
def test_derivatives_of_every_unknown_agree_with_differences(rig, name: str) -> None:
    model = mosaic_model_of(rig)
    start = nominal_placements(rig, {}, {})[name]
    rng = np.random.default_rng(1)
    # Corrections of a hundred pixels at the edge of the image, so that no term is hidden.
    values = 100.0 * rng.standard_normal(len(model.names)) * model.units
    sensor = start.sensor
    raw = rng.uniform(0.0, 1.0, (9, 2)) * [sensor.width_px - 1, sensor.height_px - 1]
    corrected = corrected_mm_from_raw(start, raw)
    at, columns, design = vip_and_design(model, start, corrected, values)
    own = [
        i for i, n in enumerate(model.names) if n.split(".")[0] in (sensor.name, start.cone.name)
    ]
    assert columns.tolist() == own
    assert {len(own)} <= {3, 4, 12}
    for row, column in zip(design, columns, strict=True):
        step = 1e-2 * model.units[column]
        moved = [values.copy(), values.copy()]
        moved[0][column] -= step
        moved[1][column] += step
        low, high = (vip_and_design(model, start, corrected, v)[0] for v in moved)
        numeric = (high - low).T / (2.0 * step)
        np.testing.assert_allclose(row * step, numeric * step, atol=2e-7, rtol=1e-5)
    # A placement at the same values carries the points to the same places.
    placed = placement_at(model, start, values)
    again, _, _ = vip_and_design(model, placed, corrected, np.zeros_like(values))
    np.testing.assert_allclose(again, at, atol=1e-6)


def test_a_step_of_one_unit_moves_the_farthest_point_by_about_a_pixel() -> None:
    model = mosaic_model_of(X_MINI)
    for name in ("SU00", "SU11"):
        start = nominal_placements(X_MINI, {}, {})[name]
        sensor = start.sensor
        corners = np.array([[0.0, 0.0], [sensor.width_px - 1.0, sensor.height_px - 1.0]])
        corrected = corrected_mm_from_raw(start, corners)
        _, columns, design = vip_and_design(model, start, corrected, np.zeros(len(model.names)))
        reach = np.abs(design).max(axis=(1, 2)) * model.units[columns]
        assert ((reach > 0.05) & (reach < 2.0)).all()
    assert len(set(model.names)) == len(model.names) == len(model.units)


def test_a_rig_without_a_virtual_image_cannot_be_stitched() -> None:
    rig = dataclasses.replace(X_MINI, virtual_image=None)
    placements = nominal_placements(X_MINI, {}, {})
    with pytest.raises(ValueError, match=r"ultracam-x-mini has no \[virtual_image\]"):
        build_model(rig, placements, free_sensors=(), free_layers=())
