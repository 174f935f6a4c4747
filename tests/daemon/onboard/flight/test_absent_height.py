"""A height that no receiver sent: absent from record, footprint and orientation."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from daemon.configuration.model import MountSection
from daemon.mission.exposure import Exposure, from_json, to_json
from daemon.mission.log.log_records import message_of, record_of
from daemon.onboard.flight.flight import Flight
from daemon.orientation.footprints import footprint_corners
from daemon.orientation.in_flight_orientation import orientation_json
from processing.quality.report import Flag
from tests.daemon.onboard.flight.test_flight import (
    NS,
    RIG,
    flight,
    fly_one,
    mark,
    nav,
    seal,
    stored_frames,
)

pytestmark = pytest.mark.trust


def flown(flying: Flight, *, has_height: bool) -> Exposure:
    """One exposure at second 0 among positions with and without a height."""
    given = fly_one(flying, 1, 0.0)
    frames = stored_frames(flying, 1, NS)
    flying.take(mark(given))
    for t_s in (-0.4, -0.2, 0.2, 0.4, 2.4):
        sample = nav(t_s)
        if not has_height:
            sample = replace(sample, fix="2d", height_m=None, vertical_sigma_m=None)
        read = record_of(message_of(sample))
        assert read == sample, "the flight log holds what was absent as absent"
        flying.take(sample)
    flying.stored(1, frames)
    return seal(flying, 5 * NS)


def test_an_exposure_among_positions_without_a_height_has_none() -> None:
    flying = flight()
    flying.track._samples.clear()
    exposure = flown(flying, has_height=False)
    assert exposure.navigation is not None
    assert exposure.navigation.height_m is None
    assert (exposure.navigation.fix, exposure.navigation.vertical_sigma_m) == ("2d", None)
    assert Flag(exposure.flags) & Flag.GNSS
    written = json.loads(json.dumps(to_json(exposure)))
    assert written["navigation"]["height_m"] is None
    assert from_json(written) == exposure
    assert footprint_corners(RIG, MountSection(), exposure.navigation, 395.0) is None
    reported = orientation_json(exposure, RIG, MountSection(), 395.0)
    assert reported["heads"] == []
    assert {one["why"] for one in reported["unoriented"]} == {"no height"}


def test_an_exposure_among_positions_with_a_height_is_oriented() -> None:
    exposure = flown(flight(), has_height=True)
    assert exposure.navigation is not None and exposure.navigation.height_m == 3395.0
    assert not Flag(exposure.flags) & Flag.GNSS
    assert orientation_json(exposure, RIG, MountSection(), 395.0)["heads"]
