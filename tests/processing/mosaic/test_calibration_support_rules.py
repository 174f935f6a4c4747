"""When calibration is called for, what is excluded from it, and what goes into the adjustment."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.geometry.placement import nominal_placements
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic import calibration_support
from processing.mosaic.calibration_support import (
    SupportSettings,
    _covariance,
    _layer_covariance,
    _probe_covariance,
    _sensor_variance,
    contradicted_colour,
    supported_mosaic,
    weakly_determined_sensors,
)
from processing.mosaic.free_mosaic import Mosaic, free_mosaic
from processing.mosaic.misfit import ProbeBias
from processing.mosaic.validity import Displacement, RelativeDisplacement, Validity
from processing.rig import Rig, find_rig
from tests.processing.mosaic.test_precision import mosaic_of
from tests.processing.synthetic import no_tie_points

Array = NDArray[np.float64]
MINI = find_rig("ultracam-x-mini")
ALL_PAN = tuple(s.name for cone in MINI.pan_cones for s in cone.sensors)


def bare_mosaic(rig: Rig) -> Mosaic:
    return free_mosaic(rig, nominal_placements(rig, {}, {}), no_tie_points(rig))


BARE = bare_mosaic(MINI)


def displacement(sensor: str) -> Displacement:
    return Displacement(sensor, 0.0, 0.0, 0.1, 0.1, 99.0)


def pair(a: str, b: str, statistic: float) -> RelativeDisplacement:
    return RelativeDisplacement("1", a, b, 0.0, 0.0, 0.1, 0.1, statistic, 10.0)


def validity_of(**found: object) -> Validity:
    """A judgement that finds nothing besides what is given."""
    nothing = {
        "observability": {},
        "residuals": (),
        "global_statistic": 0.0,
        "global_degrees_of_freedom": 4,
        "global_limit": 10.0,
        "hypotheses": (),
        "limit": 10.0,
        "displaced": None,
        "alternatives": (),
        "several_displaced": False,
        "relative": (),
    }
    # Any figure by name.
    return Validity(**(nothing | found))  # type: ignore[arg-type]


def precision(
    monkeypatch: pytest.MonkeyPatch, sigmas: dict[str, list[list[float]]]
) -> dict[str, Array]:
    """Let these sensors be placed with these sigmas (5, 2), others exactly; where was asked."""
    queried: dict[str, Array] = {}

    def sigma_px(mosaic: Mosaic, sensor: str, colrow: Array) -> Array:
        queried[sensor] = colrow
        return np.array(sigmas.get(sensor, np.zeros((5, 2))))

    monkeypatch.setattr(calibration_support, "vip_precision_px", sigma_px)
    return queried


def test_a_sensor_is_weak_by_the_rms_of_its_middle_and_corners(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    even = [[0.04, 0.04]] * 5
    below, above = np.array(even), np.array(even)
    below[2], above[2] = (0.07, 0.0), (0.09, 0.0)
    unknown = np.array(even)
    unknown[4, 1] = np.nan
    queried = precision(
        monkeypatch,
        {"SU00": below.tolist(), "SU10": above.tolist(), "SU30": unknown.tolist()},
    )
    # 0.07^2 / 10 and 0.09^2 / 10 stand for two hundredths of 0.04^2.
    below_rms, above_rms = (np.sqrt((8 * 0.04**2 + x**2) / 10) for x in (0.07, 0.09))
    settings = SupportSettings(above_px=0.5 * (below_rms + above_rms))
    assert weakly_determined_sensors(MINI, BARE, ALL_PAN, settings=settings) == ("SU10", "SU30")
    assert weakly_determined_sensors(MINI, BARE, ("SU00", "SU10", "SU01"), settings=settings) == (
        "SU10",
    )
    size = MINI.sensor("SU00")
    right, low = size.width_px - 1.0, size.height_px - 1.0
    expected = [(right / 2, low / 2), (0, 0), (right, 0), (0, low), (right, low)]
    assert sorted(map(tuple, queried["SU00"].tolist())) == sorted(expected)
    assert "G" not in queried and set(queried) == set(ALL_PAN)


def test_a_sensor_as_good_as_the_limit_is_not_weak(monkeypatch: pytest.MonkeyPatch) -> None:
    precision(monkeypatch, {"SU00": [[0.5, 0.5]] * 5})
    for above_px, weak in ((0.5, ()), (0.499, ("SU00",))):
        settings = SupportSettings(above_px=above_px)
        assert weakly_determined_sensors(MINI, BARE, ALL_PAN, settings=settings) == weak
    assert weakly_determined_sensors(MINI, BARE, ALL_PAN) == ("SU00",)
    precision(monkeypatch, {"SU00": [[0.039, 0.039]] * 5, "SU01": [[0.041, 0.041]] * 5})
    assert weakly_determined_sensors(MINI, BARE, ALL_PAN) == ("SU01",)


def colour_points() -> TiePoints:
    """P/P points of SU10 with SU00 and P/C points of SU10, SU11, SU00 and SU20 with green."""
    green = MINI.cone("G").sensors[0].name
    names = ("SU00", "SU10", "SU11", "SU20", green)
    a = np.array([1, 1, 2, 0, 3])
    b = np.array([0, 4, 4, 4, 4])
    return TiePoints(
        names=names,
        pairs=(),
        attempted=(),
        sensor_a=a,
        sensor_b=b,
        raw_a=np.zeros((5, 2)),
        raw_b=np.zeros((5, 2)),
        sigma_px=np.ones(5),
        correlation=np.ones(5),
        kind=np.array([PAN_TO_PAN, *[PAN_TO_COLOUR] * 4]),
        overlap=np.zeros(5, np.int64),
    )


def used(**points: int) -> Mosaic:
    """A mosaic that uses so many points between SU10 and each of these sensors."""
    return dataclasses.replace(BARE, used={("SU10", name): n for name, n in points.items()})


@pytest.mark.parametrize(
    ("found", "blamed"),
    [
        ({}, ""),
        ({"displaced": displacement("SU10")}, "SU10"),
        ({"insignificant_displacement": displacement("SU00")}, "SU00"),
        ({"relative": (pair("SU10", "SU11", 10.0),)}, ""),
        ({"relative": (pair("SU10", "SU11", 10.1),)}, "SU10"),
        ({"relative": (pair("SU11", "SU10", 10.1),)}, "SU10"),
        (
            {
                "probe_bias": ProbeBias("0", 1.0, 0.1, 9.0),
                "hypotheses": (displacement("SU00"), displacement("SU10")),
            },
            "SU00",
        ),
        ({"hypotheses": (displacement("SU00"),)}, ""),
    ],
)
def test_colour_points_of_a_displaced_sensor_that_others_hardly_hold_are_contradicted(
    found: dict[str, object], blamed: str
) -> None:
    """Of SU10 and SU00, with few points between them; SU11 has plenty."""
    weak = used(SU00=11, SU11=12)
    expected = {"": [], "SU10": [1], "SU00": [3]}[blamed]
    contradicted = contradicted_colour(MINI, colour_points(), weak, validity_of(**found))
    assert np.flatnonzero(contradicted).tolist() == expected
    assert contradicted.dtype == np.bool_
    firm = used(SU00=12, SU11=12)
    assert not contradicted_colour(MINI, colour_points(), firm, validity_of(**found)).any()


def test_few_points_with_a_colour_head_do_not_make_a_sensor_loose() -> None:
    green = MINI.cone("G").sensors[0].name
    mosaic = dataclasses.replace(BARE, used={("SU10", green): 3, ("SU10", "SU00"): 50})
    validity_with_displacement = validity_of(displaced=displacement("SU10"))
    assert not contradicted_colour(MINI, colour_points(), mosaic, validity_with_displacement).any()


READ = dict.fromkeys(MINI.probes, 25.0)


def covariance_by_parts(rig: Rig, mosaic: Mosaic, read: dict[str, float]) -> Array:
    """What is known of all unknowns with nothing moved, in their own units."""
    settings, model = SupportSettings(), mosaic.model
    total = np.zeros((len(model.names), len(model.names)))
    for cone in rig.cones:
        sensors = [s for s in cone.sensors if s.name in model.sensors]
        for s in sensors:
            at = model.sensors[s.name]
            total[at : at + 4, at : at + 4] += np.diag(_sensor_variance(s, read))
        total += _probe_covariance(mosaic, sensors, read, settings)
        if cone.name in model.mountings:
            at = model.mountings[cone.name]
            total[at : at + 3, at : at + 3] += np.eye(3) * (cone.rotation_sigma_urad * 1e-6) ** 2
        if cone.name in model.layers:
            at = model.layers[cone.name]
            total[at : at + 8, at : at + 8] += _layer_covariance(mosaic, cone, settings)
    return total


@pytest.mark.parametrize("name", ["ultracam-x-mini", "dmc-mini"])
def test_what_is_known_of_each_unknown_adds_up(name: str) -> None:
    rig, mosaic = mosaic_of(name)
    assert mosaic.model.layers if name.startswith("ultracam") else mosaic.model.mountings
    read = dict.fromkeys(rig.probes, 25.0)
    found = _covariance(rig, mosaic, (), read, SupportSettings())
    units = np.asarray(mosaic.model.units)
    expected = covariance_by_parts(rig, mosaic, read)
    np.testing.assert_allclose(found * units[:, None] * units[None, :], expected, rtol=1e-9)


def test_a_moved_sensor_has_ten_pixels_of_freedom_in_its_place_alone() -> None:
    moved = _covariance(MINI, BARE, ("SU10",), READ, SupportSettings())
    still = _covariance(MINI, BARE, (), READ, SupportSettings())
    units = np.asarray(BARE.model.units)
    first = BARE.model.sensors["SU10"]
    expected = np.zeros(len(units))
    expected[first : first + 2] = (10.0 * 7.2e-3) ** 2
    np.testing.assert_allclose(np.diag(moved - still) * units**2, expected, atol=1e-12)
    assert np.count_nonzero(np.abs(moved - still) > 1e-12) == 2


class Adjusted:
    """Stands for the adjustment: keeps what it was given, and finds these sigma0."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *sigma0: float) -> None:
        self.priors: list[Array] = []
        self.excluded: list[list[str]] = []
        self._sigma0 = sigma0
        monkeypatch.setattr(calibration_support, "free_mosaic", self)

    def __call__(self, *_: object, excluded_datum_sensors: list[str], prior: Array, **__: object):
        self.priors.append(prior)
        self.excluded.append(excluded_datum_sensors)
        sigma0 = self._sigma0[len(self.priors) - 1]
        return dataclasses.replace(BARE, sigma0=sigma0, redundancy=100.0, undetermined=("x",))


@pytest.mark.parametrize(("redundancy", "unit"), [(30.0, 3.0), (29.9, 1.0)])
def test_what_is_known_weighs_in_units_of_the_points_twice_adjusted(
    monkeypatch: pytest.MonkeyPatch, redundancy: float, unit: float
) -> None:
    adjusted = Adjusted(monkeypatch, 2.0, 5.0)
    mosaic = dataclasses.replace(
        BARE, sigma0=3.0, redundancy=redundancy, undetermined=("SU10.x", "SU11.y")
    )
    result = supported_mosaic(MINI, BARE.start, no_tie_points(MINI), mosaic, validity_of(), READ)
    covariance = _covariance(MINI, BARE, (), READ, SupportSettings())
    identity = np.eye(len(covariance))
    for prior, sigma0 in zip(adjusted.priors, (unit, 2.0), strict=True):
        np.testing.assert_allclose(prior @ covariance, identity * sigma0**2, atol=1e-6)
    assert adjusted.excluded == [[], []]
    assert result.sigma0 == 5.0 and result.undetermined == ("SU10.x", "SU11.y")


@pytest.mark.parametrize(
    ("found", "moved"),
    [
        ({"displaced": displacement("SU01"), "alternatives": ("SU02",)}, ["SU01", "SU02"]),
        ({"insignificant_displacement": displacement("SU03")}, ["SU03"]),
        (
            {"displaced": displacement("SU01"), "several_displaced": True},
            ["SU00", "SU01", "SU02", "SU03"],
        ),
        ({"several_displaced": True}, []),
        ({"relative": (pair("SU10", "SU11", 10.1),)}, []),
    ],
)
def test_a_master_sensor_that_moved_is_no_datum(
    monkeypatch: pytest.MonkeyPatch, found: dict[str, object], moved: list[str]
) -> None:
    adjusted = Adjusted(monkeypatch, 1.0, 1.0)
    validity = validity_of(**found)
    supported_mosaic(MINI, BARE.start, no_tie_points(MINI), BARE, validity, READ)
    assert adjusted.excluded[0] == moved
    free = {*moved, *(("SU10", "SU11") if validity.relative else ())}
    covariance = _covariance(MINI, BARE, free, READ, SupportSettings())
    np.testing.assert_allclose(adjusted.priors[0] @ covariance, np.eye(len(covariance)), atol=1e-6)


def test_sensors_that_agree_are_supported(monkeypatch: pytest.MonkeyPatch) -> None:
    adjusted = Adjusted(monkeypatch, 1.0, 1.0)
    validity = validity_of(relative=(pair("SU10", "SU11", 10.0),))
    supported_mosaic(MINI, BARE.start, no_tie_points(MINI), BARE, validity, READ)
    covariance = _covariance(MINI, BARE, (), READ, SupportSettings())
    np.testing.assert_allclose(adjusted.priors[0] @ covariance, np.eye(len(covariance)), atol=1e-6)
