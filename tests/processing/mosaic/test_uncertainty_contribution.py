"""What each finding of an exposure adds to the stated accuracy, by numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.projective import apply_projective, rotation_homography
from processing.geometry.rotation import rotation_matrix
from processing.geometry.similarity import fit_similarity
from processing.mosaic.datum import datum_candidates
from processing.mosaic.estimated_dc import EstimatedDc
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.held import HeldPart, HeldQuantities
from processing.mosaic.layers import LayerChange, LayerCheck
from processing.mosaic.mounting import EstimatedMounting, PlatformCheck
from processing.mosaic.precision import UncertaintyContribution, datum_per_kelvin_px
from processing.mosaic.readout_slips import Slip
from processing.mosaic.uncertainty_contribution import (
    MIN_DISPLACEMENT_PX,
    CalibrationChecks,
    uncertainty_contribution_of,
)
from processing.mosaic.validity import Displacement, Validity
from processing.rig import Rig
from tests.processing.mosaic.test_precision import mosaic_of

Array = NDArray[np.float64]


def found(
    rig: Rig,
    mosaic: Mosaic,
    *,
    validity: Validity | None = None,
    estimated_dc: tuple[EstimatedDc, ...] = (),
    layers: LayerCheck | None = None,
    slips: tuple[Slip, ...] = (),
    platform: PlatformCheck | None = None,
    held: HeldQuantities | None = None,
    stale_s: float = 0.0,
    shifted_px: float = 0.0,
    weak: tuple[str, ...] = (),
    smear_px: dict[str, float] | None = None,
) -> UncertaintyContribution:
    return uncertainty_contribution_of(
        rig,
        mosaic,
        validity=validity,
        checks=CalibrationChecks(estimated_dc, layers, platform),
        slips=slips,
        held=held,
        temperatures_c=dict.fromkeys(rig.probes, 20.0),
        stale_s=stale_s,
        shifted_px=shifted_px,
        weak=weak,
        smear_px=smear_px,
    )


def estimate(cone: str, k: float | None, measured: float | None, *, off: bool) -> EstimatedDc:
    return EstimatedDc(cone, k, None if k is None else 0.5, measured, 10.0, 3.0, off)


def test_nothing_found_adds_nothing() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    nothing = found(rig, mosaic)
    assert not nothing.datum.any() and nothing.datum.shape == (4, 4) and not nothing.frames


def test_a_slip_adds_the_variance_of_its_share_of_the_frame() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    slips = (
        Slip("SU10", "rows", 0, 83, 3.0, -4.0, 0.1, 30.0, 50),
        Slip("SU10", "rows", 400, 649, 1.0, 2.0, 0.3, 30.0, 50),
        Slip("SU20", "columns", 0, 99, -2.0, 0.0, 0.5, 30.0, 50),
    )
    frames = found(rig, mosaic, slips=slips).frames
    assert set(frames) == {"SU10", "SU20"}
    assert frames["SU10"] == pytest.approx([0.1 * 9.0 + 0.3, 0.1 * 16.0 + 0.3 * 4.0])
    assert frames["SU20"] == pytest.approx([2.0, 0.0])


@pytest.mark.parametrize(("dy_px", "added"), [(0.09, 0.0), (-0.09, 0.0), (-0.11, 0.00363)])
def test_of_a_slip_along_one_axis_the_error_of_the_other_adds_nothing(
    dy_px: float, added: float
) -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    slips = (Slip("SU10", "columns", 0, 83, -2.0, dy_px, 0.3, 30.0, 50),)
    assert found(rig, mosaic, slips=slips).frames["SU10"] == pytest.approx([1.2, added])


def test_a_wrong_probe_of_the_master_moves_the_datum_by_its_error() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    per_k = datum_per_kelvin_px(rig, mosaic)
    wrong = (estimate("0", 8.0, 5.0, off=True), estimate("1", 7.0, 7.0, off=False))
    datum = found(rig, mosaic, estimated_dc=wrong).datum
    np.testing.assert_allclose(datum, 9.0 * np.outer(per_k, per_k), rtol=1e-9)
    unread = (estimate("0", 8.0, None, off=True),)
    assert not found(rig, mosaic, estimated_dc=unread).datum.any()


def test_probes_of_other_cones_count_only_where_all_of_them_are_off() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    per_k = datum_per_kelvin_px(rig, mosaic)
    one = estimate("1", 9.0, 4.0, off=True)
    healthy = estimate("2", 4.0, 4.0, off=False)
    assert not found(rig, mosaic, estimated_dc=(one, healthy)).datum.any()
    both = (one, estimate("2", 7.0, 6.0, off=True), estimate("3", None, 4.0, off=False))
    # The mean of the estimates less the mean of the readings: 8 - 5.
    datum = found(rig, mosaic, estimated_dc=both).datum
    np.testing.assert_allclose(datum, 9.0 * np.outer(per_k, per_k), rtol=1e-9)


def check(common: tuple[float, ...], *, changed: bool, causes: tuple[str, ...] = ()) -> LayerCheck:
    sigmas = np.array([10.0, 5.0, 5.0, 5.0])
    statistic = 20.0 if changed else 3.0
    return LayerCheck("0", (), statistic, 10.0, np.array(common), sigmas, causes, ())


def test_a_changed_master_moves_the_image_as_its_rotation_does() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    f, pitch = mosaic.model.f_mm, mosaic.model.pitch_mm
    angles = np.array([14.0, -7.0, 11.0])
    datum = found(rig, mosaic, layers=check((30.0, *angles), changed=True, causes=("0",))).datum
    near = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    homography = rotation_homography(rotation_matrix(*angles * 1e-6), f, f)
    fit = fit_similarity(near, apply_projective(homography, near))
    # The turn about y, 1.4 sigmas, is as good as none.
    part = np.array([0.0, fit.y_mm, 30e-6, fit.rotation_rad]) / pitch
    np.testing.assert_allclose(datum, np.diag(part**2), rtol=1e-3)


def test_a_common_scale_counts_beyond_two_standard_deviations() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    for scale, beyond in ((19.0, 0.0), (-29.0, 29.0**2 - 400.0)):
        datum = found(rig, mosaic, layers=check((scale, 4.0, 5.0, 6.0), changed=False)).datum
        expected = np.diag([0.0, 0.0, beyond, 0.0]) * (1e-6 / mosaic.model.pitch_mm) ** 2
        np.testing.assert_allclose(datum, expected, rtol=1e-9, atol=1e-18)
    other = check((90.0, 4.0, 5.0, 6.0), changed=True, causes=("2",))
    assert not found(rig, mosaic, layers=other).datum.any()


def test_a_common_scale_counts_beyond_one_sigma_and_as_warmth_where_the_master_is_one_sensor() -> (
    None
):
    rig, mosaic = mosaic_of("ultracam-l-mini")
    per_k = datum_per_kelvin_px(rig, mosaic)
    datum = found(rig, mosaic, layers=check((-19.0, 4.0, 5.0, 6.0), changed=False)).datum
    scale = np.sqrt(19.0**2 - 10.0**2) * 1e-6 / mosaic.model.pitch_mm
    part, scaled = per_k / per_k[2] * scale, np.diag([0.0, 0.0, scale**2, 0.0])
    # A principal distance is as likely as a temperature.
    np.testing.assert_allclose(datum, (np.outer(part, part) + scaled) / 2.0, rtol=1e-9)
    assert np.hypot(*part[:2]) > 0.01 and part[2] == pytest.approx(scale)
    none = found(rig, mosaic, layers=check((9.0, 4.0, 5.0, 6.0), changed=False)).datum
    assert not none.any()


@pytest.mark.parametrize(("name", "alone"), [("ultracam-x-mini", False), ("ultracam-l-mini", True)])
def test_where_several_cones_changed_the_master_is_known_no_better(name: str, alone: bool) -> None:
    rig, mosaic = mosaic_of(name)
    changes = [np.array([300.0, 40.0, -50.0, 9.0]), np.array([-400.0, 0.0, 70.0, 8.0])]
    layers = dataclasses.replace(
        check((0.0, 0.0, 0.0, 0.0), changed=True, causes=("1", "RGB")),
        layers=tuple(
            LayerChange(n, v, v, 1.0)
            for n, v in zip(("1", "RGB" if alone else "2"), changes, strict=True)
        ),
    )
    datum = found(rig, mosaic, layers=layers).datum
    per_mm = 1e-6 / mosaic.model.pitch_mm
    f_px = mosaic.model.f_mm * per_mm
    # Of directions PAN alone counts.
    shift = (40.0**2 + 50.0**2) / 2.0 * f_px**2 * alone
    scale = (300.0**2 + 400.0**2) / 2.0 * per_mm**2
    np.testing.assert_allclose(datum, np.diag([shift, shift, scale, 0.0]), rtol=1e-9)
    # A single master sensor that changed as well is known no better.
    also = dataclasses.replace(layers, causes=("1", "0"))
    of_master = found(rig, mosaic, layers=also).datum
    if alone:
        np.testing.assert_allclose(of_master, datum, rtol=1e-9)
    else:
        assert not of_master.any()


def test_old_temperatures_move_the_datum_by_their_age() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    per_k = datum_per_kelvin_px(rig, mosaic)
    datum = found(rig, mosaic, stale_s=100.0).datum
    np.testing.assert_allclose(datum, 4.0 * np.outer(per_k, per_k), rtol=1e-9)


def _head(name: str, rotation: tuple[float, float, float], ppm: float) -> EstimatedMounting:
    none, zero = np.zeros((3, 3)), (0.0, 0.0)
    affine = np.eye(2) * ppm * 1e-6
    return EstimatedMounting(
        name, (0.0, 0.0, 0.0), none, rotation, (0.0, 0.0, 0.0), zero, zero, zero, affine, 90
    )


def quantities(mosaic: Mosaic, scales: tuple[float, ...]) -> HeldQuantities:
    """Heads whose errors of place and scale the adjustment leaves as they are."""
    still, names = np.zeros(len(mosaic.model.names)), tuple(mosaic.model.mountings)
    parts = {name: tuple(HeldPart(still, {name: row}) for row in np.eye(3)) for name in names}
    return HeldQuantities(names, parts, np.array(scales), np.full(len(names), 1e-6), still)


def test_heads_that_turned_move_the_mean_and_may_have_displaced_sensors() -> None:
    rig, mosaic = mosaic_of("dmc-mini")
    heads = (_head("1", (3e-5, 0.0, 0.0), 0.0), _head("2", (-4e-5, -6e-5, 9e-5), 0.0))
    expired = PlatformCheck(heads, np.zeros((6, 6)), 50.0, 3, 20.0)
    held = quantities(mosaic, (0.0, 0.0, 0.0, 0.0))
    disturbed = found(rig, mosaic, platform=expired, held=held)
    f_px, pitch = mosaic.model.f_mm / mosaic.model.pitch_mm, mosaic.model.pitch_mm
    first = np.array([0.0, 3e-5 * f_px, 0.0, 0.0])
    second = np.array([6e-5 * f_px, -4e-5 * f_px, 0.0, 9e-5 / pitch])
    expected = np.outer(first, first) + np.outer(second, second)
    np.testing.assert_allclose(disturbed.datum, expected, rtol=1e-9)
    of_second = [part.layers["2"] for part in disturbed.parts[-2:]]
    shifts = np.diag([6e-5, -4e-5, 0.0])[:2] * mosaic.model.f_mm
    np.testing.assert_allclose(of_second, shifts, atol=1e-12)
    usual = tuple(dataclasses.replace(head, usual_rad=5e-5) for head in heads)
    fits = dataclasses.replace(expired, heads=usual, statistic=19.0)
    fewer = found(rig, mosaic, platform=fits, held=held)
    assert not fewer.datum.any() and len(fewer.parts) == len(disturbed.parts) - 4


def test_heads_with_other_scales_state_one_pattern_and_what_they_share() -> None:
    rig, mosaic = mosaic_of("dmc-mini")
    heads = tuple(_head(name, (0.0, 0.0, 0.0), 0.0) for name in "1234")
    expired = PlatformCheck(heads, np.zeros((12, 12)), 50.0, 9, 20.0)
    pitch = mosaic.model.pitch_mm
    healthy = len(found(rig, mosaic, held=quantities(mosaic, (0.0, 49e-6, 0.0, 0.0))).parts)
    one = found(rig, mosaic, platform=expired, held=quantities(mosaic, (0.0, 3e-4, 0.0, 0.0)))
    assert not one.datum.any()
    assert one.parts[healthy].layers["2"][2] == pytest.approx(3e-4)
    both = quantities(mosaic, (0.0, 3e-4, -4e-4, 0.0))
    two = found(rig, mosaic, platform=expired, held=both)
    np.testing.assert_allclose(two.datum[2, 2], (9e-8 + 16e-8) / 4.0 / pitch**2, rtol=1e-9)
    assert two.parts[healthy].layers["3"][2] == pytest.approx(-4e-4)


@pytest.mark.parametrize(("name", "sigma"), [("ultracam-x-mini", 0.6), ("dmc-mini", 0.15)])
def test_a_count_of_shifts_that_does_not_fit_the_motion_moves_the_datum_by_half(
    name: str, sigma: float
) -> None:
    rig, mosaic = mosaic_of(name)
    cone = rig.cone_of(datum_candidates(rig)[0].name).name
    datum = found(rig, mosaic, smear_px={cone: 1.2, "G": 5.0}).datum
    np.testing.assert_allclose(datum, np.diag([0.0, sigma**2, 0.0, 0.0]), rtol=1e-9)


def test_what_another_scale_makes_of_a_turn_is_no_turn() -> None:
    rig, mosaic = mosaic_of("dmc-mini")
    heads = tuple(_head(name, (3e-5, 0.0, 0.0), 0.0) for name in "1234")
    expired = PlatformCheck(heads, np.zeros((12, 12)), 50.0, 9, 20.0)
    held = quantities(mosaic, (0.0, 3e-4, 0.0, 0.0))
    away = np.zeros(len(mosaic.model.names))
    away[list(mosaic.model.mountings.values())] = 3e-5
    assert found(rig, mosaic, platform=expired, held=held).datum.any()
    explained = dataclasses.replace(held, away=away)
    assert not found(rig, mosaic, platform=expired, held=explained).datum.any()


def test_old_temperatures_warm_converging_heads_each_by_itself() -> None:
    rig, mosaic = mosaic_of("dmc-mini")
    held = quantities(mosaic, (0.0, 0.0, 0.0, 0.0))
    read = found(rig, mosaic, held=held).parts
    stale = found(rig, mosaic, held=held, stale_s=100.0).parts
    # 0.1 K of a probe that was read; 2 K of one that was read 100 s ago in addition.
    ratios = [b.layers["2"][2] / a.layers["2"][2] for a, b in zip(read, stale, strict=True)
              if "2" in a.layers and a.layers["2"][2]]  # fmt: skip
    assert ratios == pytest.approx([np.hypot(0.1, 2.0) / 0.1] * len(ratios)) and ratios


def test_frames_that_lay_elsewhere_and_rest_on_calibration_are_as_uncertain_as_their_shift() -> (
    None
):
    rig, mosaic = mosaic_of("ultracam-x-mini")
    nothing = found(rig, mosaic, shifted_px=30.0)
    assert not nothing.datum.any() and not nothing.parts
    assert not found(rig, mosaic, weak=("SU30",)).parts
    some = found(rig, mosaic, shifted_px=30.0, weak=("SU30",))
    half_mm = mosaic.model.half_size_mm
    expected = np.diag([25.0, 25.0, 25.0 / half_mm**2, 25.0 / half_mm**2])
    np.testing.assert_allclose(some.datum, expected, rtol=1e-9)
    names, units = mosaic.model.names, mosaic.model.units
    sizes = {
        names[i]: part.unknowns[i] / units[i]
        for part in some.parts
        for i in np.flatnonzero(part.unknowns)
    }
    owner = rig.cone_of("SU30").name
    assert sizes == {n: pytest.approx(10.0) for n in names if n.split(".")[0] in ("SU30", owner)}


def test_a_wrong_temperature_explains_a_common_scale() -> None:
    rig, mosaic = mosaic_of("ultracam-x-mini")
    wrong = (estimate("0", 8.0, 5.0, off=True),)
    alone = found(rig, mosaic, estimated_dc=wrong).datum
    both = found(
        rig, mosaic, estimated_dc=wrong, layers=check((90.0, 0.0, 0.0, 0.0), changed=False)
    ).datum
    np.testing.assert_array_equal(both, alone)


def displaced_mosaic(moved_px: dict[str, tuple[float, float]]) -> tuple[Rig, Mosaic]:
    """A mosaic whose datum was fitted over all four master sensors, some of them displaced."""
    rig, mosaic = mosaic_of("ultracam-x-mini")
    pitch = mosaic.model.pitch_mm
    sensors = rig.master_sensors
    place = np.array([[s.x_mm, s.y_mm] for s in sensors])
    moved = np.array([moved_px.get(s.name, (0.0, 0.0)) for s in sensors]) * pitch
    fit = fit_similarity(place, place + moved)
    z = (place[:, 0] + 1j * place[:, 1]) * (fit.scale * np.exp(1j * fit.rotation_rad) - 1.0)
    left = moved - np.column_stack([z.real + fit.x_mm, z.imag + fit.y_mm])
    values = mosaic.values.copy()
    for s, (x, y) in zip(sensors, left, strict=True):
        values[mosaic.model.sensors[s.name]] = x
        values[mosaic.model.sensors[s.name] + 1] = y
    return rig, dataclasses.replace(mosaic, values=values)


def validity_of(
    sensor: str, alternatives: tuple[str, ...] = (), *, several: bool = False
) -> Validity:
    displaced = Displacement(sensor, 3.0, 4.0, 0.1, 0.1, 900.0)
    return Validity(
        {}, (), 900.0, 4, 20.0, (displaced,), 15.0, displaced, alternatives, several, ()
    )


def refit(rig: Rig, mosaic: Mosaic, trusted: tuple[str, ...]) -> tuple[Array, Array]:
    """The datum that rests on some sensors (px, px per mm), and where it leaves all, px."""
    pitch = mosaic.model.pitch_mm
    place = np.array([[s.x_mm, s.y_mm] for s in rig.master_sensors])
    first = [mosaic.model.sensors[s.name] for s in rig.master_sensors]
    moved = np.array([mosaic.values[i : i + 2] for i in first])
    use = np.array([s.name in trusted for s in rig.master_sensors])
    fit = fit_similarity(place[use], (place + moved)[use])
    z = (place[:, 0] + 1j * place[:, 1]) * (fit.scale * np.exp(1j * fit.rotation_rad) - 1.0)
    part = np.array([fit.x_mm, fit.y_mm, fit.scale - 1.0, fit.rotation_rad]) / pitch
    left = (moved - np.column_stack([z.real + fit.x_mm, z.imag + fit.y_mm])) / pitch
    return part, left[~use]


MASTER = ("SU00", "SU01", "SU02", "SU03")


def test_a_displaced_sensor_drags_the_datum_by_what_the_other_three_say() -> None:
    rig, mosaic = displaced_mosaic({"SU00": (3.0, -2.0)})
    part, left = refit(rig, mosaic, MASTER[1:])
    np.testing.assert_allclose(left, [[3.0, -2.0]], atol=1e-3)
    datum = found(rig, mosaic, validity=validity_of("SU00")).datum
    np.testing.assert_allclose(datum, np.outer(part, part), rtol=5e-3, atol=1e-9)
    insignificant_displacement = dataclasses.replace(
        validity_of("SU00"),
        displaced=None,
        insignificant_displacement=validity_of("SU00").displaced,
    )
    np.testing.assert_array_equal(
        found(rig, mosaic, validity=insignificant_displacement).datum, datum
    )
    healthy = dataclasses.replace(validity_of("SU00"), displaced=None)
    assert not found(rig, mosaic, validity=healthy).datum.any()


def mixed(parts: list[tuple[Array, Array]]) -> Array:
    """The mean over explanations, the smaller displacement the likelier."""
    weights = [
        np.prod([1.0 / (x * x + y * y + MIN_DISPLACEMENT_PX**2) for x, y in left])
        for _, left in parts
    ]
    every = [w * np.outer(part, part) for w, (part, _) in zip(weights, parts, strict=True)]
    return np.asarray(sum(every) / sum(weights))


def test_of_several_suspects_each_datum_counts_with_its_likelihood() -> None:
    assert MIN_DISPLACEMENT_PX == 0.02
    rig, mosaic = displaced_mosaic({"SU00": (0.05, -0.02), "SU03": (0.01, 0.03)})
    datum = found(rig, mosaic, validity=validity_of("SU00", ("SU03",))).datum
    expected = mixed([refit(rig, mosaic, MASTER[1:]), refit(rig, mosaic, MASTER[:3])])
    np.testing.assert_allclose(datum, expected, rtol=2e-3, atol=1e-12)


def test_where_several_moved_any_two_may_be_in_place() -> None:
    rig, mosaic = displaced_mosaic({"SU00": (0.5, -0.2), "SU03": (0.1, 0.4)})
    datum = found(rig, mosaic, validity=validity_of("SU00", several=True)).datum
    pairs = [(a, b) for i, a in enumerate(MASTER) for b in MASTER[i + 1 :]]
    expected = mixed([refit(rig, mosaic, pair) for pair in pairs])
    np.testing.assert_allclose(datum, expected, rtol=5e-3, atol=1e-9)


def test_heads_that_turned_nearly_as_far_are_alternatives() -> None:
    turns = {"1": 0.9, "2": 2.0, "3": 1.1, "4": 0.99}
    heads = tuple(
        dataclasses.replace(_head(name, (0.0, 0.0, 0.0), 0.0), turn=turn)
        for name, turn in turns.items()
    )
    failed = PlatformCheck(heads, np.eye(12), 50.0, 9, 20.0)
    assert failed.farthest.cone == "2" and failed.alternatives == ("3",)
    assert dataclasses.replace(failed, statistic=20.0).alternatives == ()


def test_a_turn_that_is_not_significant_moves_the_mean_by_what_is_beyond_the_usual() -> None:
    rig, mosaic = mosaic_of("dmc-mini")
    heads = tuple(
        dataclasses.replace(_head(name, (angle, 0.0, 0.0), 0.0), usual_rad=2e-5)
        for name, angle in (("1", 3.9e-5), ("2", -5e-5))
    )
    passed = PlatformCheck(heads, np.zeros((6, 6)), 19.0, 3, 20.0)
    held = quantities(mosaic, (0.0, 0.0, 0.0, 0.0))
    f_px = mosaic.model.f_mm / mosaic.model.pitch_mm
    beyond = np.array([0.0, -3e-5 * f_px, 0.0, 0.0])
    np.testing.assert_allclose(
        found(rig, mosaic, platform=passed, held=held).datum, np.outer(beyond, beyond), atol=1e-12
    )
