"""A short emulated flight with every kind of receiver: its marks are matched, and matched right."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from tests.system.demo_mission import fly, syntopic

pytestmark = [pytest.mark.system, pytest.mark.soak, pytest.mark.timeout(600)]

RIG = "ultracam-l-mini"
TIME_WITHIN_NS = {"ublox": 0, "novatel": 1, "septentrio": 1, "nmea": 500, "mavlink": 1_000_000}
"""The resolution of each protocol's event marks."""
PLACE_WITHIN_M = {"ublox": 0.05, "novatel": 0.02, "septentrio": 0.02, "nmea": 0.8, "mavlink": 0.2}
"""Interpolated from samples every 0.2 s; NMEA cuts its epochs to 10 ms, an autopilot to 1 ms."""


@pytest.mark.parametrize("receiver", list(TIME_WITHIN_NS))
def test_three_of_three_exposures_have_the_mark_of_their_own_strobe(
    receiver: str, tmp_path: Path
) -> None:
    flown = fly(tmp_path, "--rig", RIG, "--exposures", "3", "--receiver", receiver)
    summary = flown.summary
    assert (summary["exposures"], summary["complete"], summary["lost"]) == (3, 3, 0)
    assert summary["ledger_balanced"] is True
    records = sorted((flown.mission / "L0").glob("*/exposure.json"))
    assert len(records) == 3
    for path in records:
        record = json.loads(path.read_text())
        truth = np.load(flown.truth / f"{path.parent.name}.npz")
        assert record["mark_source"] == "event-mark"
        error_ns = int(record["mark_gps_ns"]) - int(truth["mark_gps_ns"])
        assert abs(error_ns) <= TIME_WITHIN_NS[receiver]
        latitude, longitude, height = truth["latitude_longitude_height"]
        place = record["navigation"]
        north_m = (place["latitude_deg"] - latitude) * 111_320
        east_m = (place["longitude_deg"] - longitude) * 111_320 * np.cos(np.radians(latitude))
        assert np.hypot(north_m, east_m) < PLACE_WITHIN_M[receiver]
        assert abs(place["height_m"] - height) < 0.1
    raw = syntopic("export", "raw", str(flown.mission), "--json")
    assert json.loads(raw.stdout)["events"] == 3
    replayed = syntopic("replay", str(flown.mission), "--records-only", "--json")
    assert replayed.returncode == 0, replayed.stdout


def test_check_finds_all_devices_of_a_rig_with_an_ascii_instrument_and_an_autopilot(
    tmp_path: Path,
) -> None:
    arguments = simulator_arguments(RIG, tmp_path, seed=1, dc=0.0, displace=[])
    arguments += ["--first-address", free_first_address(), "--exposures", "2"]
    devices = Emulator([*arguments, "--probe", "ascii", "--receiver", "mavlink"])
    try:
        config = tmp_path / "service.toml"
        config.write_text(service_toml(devices.ready, root="missions"))
        done = syntopic("check", str(config), "--json")
    finally:
        devices.end()
    assert done.returncode == 0, done.stdout
    found = {finding["name"]: finding for finding in json.loads(done.stdout)["findings"]}
    assert found["probes"]["found"]["driver"] == "ascii-line"
    assert found["gnss"]["found"]["autopilot"] == "PX4"
