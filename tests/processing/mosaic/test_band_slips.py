"""Read-out slips of heads that are registered to green, by synthetic matches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    raw_from_vip_mm,
    vip_mm_from_raw,
)
from processing.image.colour import BandRegistration, ColourSettings, fitted_registration
from processing.mosaic.band_slips import without_band_slips
from processing.rig import find_rig

pytestmark = pytest.mark.trust

X = find_rig("ultracam-x-mini")
PLACES = nominal_placements(X, {}, {})
GREEN = PLACES["G"]
SETTINGS = ColourSettings()
SIGMA_PX = 0.15


def _band(
    name: str, seed: int, *, shift: tuple[int, int, float] | None = None, off_px: float = 0.0
) -> BandRegistration:
    """Matches of a head with green; rows of `shift` are those so many rows further on."""
    random, sensor = np.random.default_rng(seed), X.sensor(name)
    at = random.uniform(20.0, [sensor.width_px - 21.0, sensor.height_px - 21.0], (500, 2))
    raw = raw_from_vip_mm(PLACES[name], vip_mm_from_raw(GREEN, at))
    raw[:, 0] += off_px * raw[:, 1] / sensor.height_px
    raw += random.normal(0.0, SIGMA_PX, raw.shape)
    if shift is not None:
        first, last, by = shift
        raw[(raw[:, 1] >= first) & (raw[:, 1] < last), 1] -= by
    matched = BandRegistration(
        name, name, np.eye(3), 0, None, registered=False, matched_at=raw,
        green_at=at, sigma_px=np.full(len(at), SIGMA_PX),
    )  # fmt: skip
    every: NDArray[Any] = np.ones(len(at), np.bool_)
    return fitted_registration(matched, GREEN, PLACES[name], every, SETTINGS)


def _searched(*bands: BandRegistration) -> Any:
    places: dict[str, SensorPlacement] = PLACES
    return without_band_slips(X, GREEN, places, bands, settings=SETTINGS)


def test_healthy_heads_have_none_and_stay_as_registered() -> None:
    bands = (_band("R", 1), _band("B", 2, off_px=2.0), _band("N", 3))
    registrations, slips = _searched(*bands)
    assert slips == () and all(a is b for a, b in zip(registrations, bands, strict=True))


@pytest.mark.parametrize("shift", [(416, 832, 3.0), (250, 330, 2.0), (0, 110, -1.0)])
def test_shifted_rows_are_found_with_size_and_place(shift: tuple[int, int, float]) -> None:
    bands = (_band("R", 1), _band("B", 2, shift=shift), _band("N", 3))
    registrations, (slip,) = _searched(*bands)
    assert (slip.sensor, slip.axis, slip.alternatives) == ("B", "rows", ())
    # Three PAN pixels are one of colour; y points up.
    assert abs(slip.dy_px) == pytest.approx(3.0 * abs(shift[2]), abs=0.3)
    assert slip.first == pytest.approx(shift[0], abs=25)
    assert slip.last == pytest.approx(shift[1], abs=25)
    rms = [r.rms_px for r in registrations]
    assert registrations[0] is bands[0] and registrations[2] is bands[2]
    # The lines in place fit as well as those of the other heads.
    assert rms[1] == pytest.approx(rms[0], rel=0.25)


def test_what_all_heads_see_at_one_place_is_a_slip_of_green() -> None:
    shift = (300, 420, 2.0)
    (first, *_) = _searched(*(_band(n, k, shift=shift) for k, n in enumerate("RBN")))[1]
    assert first.sensor == "G" and first.axis == "rows"


def test_a_single_head_is_named_itself() -> None:
    _, (slip,) = _searched(_band("N", 4, shift=(300, 420, 2.0)))
    assert slip.sensor == "N" and slip.alternatives == ()


def test_a_head_without_enough_points_outside_of_the_slip_stays_as_calibrated() -> None:
    few = ColourSettings(min_points=400)
    band = _band("N", 5, shift=(250, 600, 2.0))
    (registration,), (slip,) = without_band_slips(X, GREEN, PLACES, (band,), settings=few)
    assert slip.sensor == "N" and not registration.registered
    np.testing.assert_array_equal(registration.band_from_green, np.eye(3))
