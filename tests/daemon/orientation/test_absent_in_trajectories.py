"""A trajectory has heights and sigmas only where its samples have them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.orientation.trajectory import Trajectory, read_trajectory
from drivers.contract import NavSample
from tests.daemon.onboard.flight.test_flight import GPS_NS, NS, nav

pytestmark = pytest.mark.trust


def trajectory(*samples: NavSample) -> Trajectory:
    instants = np.array([sample.gps_ns for sample in samples], dtype=np.int64)
    return Trajectory("test", instants, samples.__getitem__)


def flat(t_s: float) -> NavSample:
    return replace(nav(t_s), fix="2d", height_m=None, vertical_sigma_m=None)


def test_a_height_comes_from_the_nearest_samples_that_have_one() -> None:
    flown = trajectory(nav(0.0), flat(0.2), flat(0.4), flat(0.6), nav(0.8), flat(1.0))
    for tenths in range(8):
        there = flown.at(GPS_NS + tenths * NS // 10)
        assert there is not None
        assert (there.height_m, there.fix) == (3395.0, "3d")


def test_after_the_last_height_it_is_carried_on_with_a_growing_sigma() -> None:
    flown = trajectory(nav(0.0), nav(0.2), flat(0.4), flat(0.6), flat(1.8), flat(2.6), flat(2.8))
    sigmas = []
    for tenths in (2, 3, 5, 17):
        there = flown.at(GPS_NS + tenths * NS // 10)
        assert there is not None and there.vertical_sigma_m is not None
        assert (there.height_m, there.fix) == (3395.0, "2d")
        sigmas.append(there.vertical_sigma_m)
    assert sigmas[0] == 0.9 and sigmas == sorted(set(sigmas)) and sigmas[-1] > 2.0
    there = flown.at(GPS_NS + 27 * NS // 10)
    assert there is not None and there.height_m is None


def test_without_a_height_within_two_seconds_there_is_none() -> None:
    flown = trajectory(nav(0.0), flat(2.5), flat(2.7), flat(2.9), nav(6.0))
    there = flown.at(GPS_NS + 28 * NS // 10)
    assert there is not None
    assert (there.height_m, there.vertical_sigma_m, there.fix) == (None, None, "2d")
    assert there.horizontal_sigma_m is not None and there.horizontal_sigma_m >= 0.5


def test_a_post_processed_trajectory_states_no_sigma(tmp_path: Path) -> None:
    path = tmp_path / "flown.csv"
    path.write_text(
        "gps_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg\n"
        + "".join(f"{GPS_NS + k * NS // 10},48.0,11.0,3000.0,0,0,0\n" for k in range(4))
    )
    there = read_trajectory(path, around_gps_ns=GPS_NS).at(GPS_NS + NS // 20)
    assert there is not None
    assert (there.height_m, there.horizontal_sigma_m, there.vertical_sigma_m) == (
        3000.0,
        None,
        None,
    )
    assert (there.sigma_source, there.satellites) == ("none", None)
