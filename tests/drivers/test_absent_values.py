"""Values that receivers mark as not available are absent in the record, for every protocol."""

from __future__ import annotations

import math
import struct

import pytest

from drivers.contract import NavSample
from drivers.receivers.ublox.decoder import UbxDecoder
from tests.drivers import test_mavlink as mavlink
from tests.drivers import test_novatel as novatel
from tests.drivers import test_septentrio as septentrio
from tests.drivers.ubx_frames import frame, nav_pvt

pytestmark = pytest.mark.trust

TEN_UTC = (2026, 11, 21, 10, 0, 0)
ITOW = (6 * 86_400 + 36_018) * 1000


def ublox(message: bytes) -> NavSample:
    (sample,) = UbxDecoder("gnss").feed(message, 0)
    assert isinstance(sample, NavSample)
    return sample


def assert_no_position(sample: NavSample) -> None:
    assert sample.position is None
    assert sample.latitude_deg is sample.longitude_deg is sample.height_m is None
    assert sample.horizontal_sigma_m is sample.vertical_sigma_m is None
    assert sample.velocity_ned_mps is sample.speed_sigma_mps is None


@pytest.mark.parametrize(("fix_type", "flags"), [(0, 0), (0, 1), (3, 0), (5, 1), (9, 1)])
def test_ublox_without_a_fix_has_no_position(fix_type: int, flags: int) -> None:
    assert_no_position(ublox(nav_pvt(ITOW, TEN_UTC, fix_type=fix_type, flags=flags)))


def test_ublox_in_two_dimensions_has_no_height() -> None:
    sample = ublox(nav_pvt(ITOW, TEN_UTC, fix_type=2))
    assert (sample.fix, sample.height_m, sample.vertical_sigma_m) == ("2d", None, None)
    assert sample.position == (47.5, 8.5)


def test_ublox_accuracies_of_all_ones_are_not_known() -> None:
    message = bytearray(nav_pvt(ITOW, TEN_UTC)[6:-2])
    for at in (40, 44, 68):
        message[at : at + 4] = b"\xff" * 4
    sample = ublox(frame(0x01, 0x07, bytes(message)))
    assert sample.horizontal_sigma_m is sample.vertical_sigma_m is sample.speed_sigma_mps is None
    assert sample.height_m == 1000.0


def test_septentrio_values_that_are_not_to_be_used_are_absent() -> None:
    stream_bytes = (
        septentrio.pvt(1000, error=1) + septentrio.pvt(1200, mode=0x84) + septentrio.pvt(1400)
    )
    none, flat = septentrio.samples(stream_bytes)[:2]
    assert_no_position(none)
    assert (flat.fix, flat.height_m, flat.vertical_sigma_m) == ("2d", None, None)
    body = bytearray(septentrio.pvt(1000)[14:])
    struct.pack_into("<f", body, 2 + 24 + 4, septentrio.UNKNOWN)  # velocity north
    body[74 - 14] = 0xFF  # satellites
    still = septentrio.block(4007, bytes(body), tow_ms=1000, revision=2)
    (sample, *_) = septentrio.samples(still + septentrio.pvt(1200))
    assert sample.velocity_ned_mps is None
    assert (sample.satellites, sample.position) == (None, pytest.approx((47.5, 8.5)))


@pytest.mark.parametrize(
    ("status", "kind", "fix"), [(1, 50, "none"), (0, 1, "time"), (0, 2, "2d"), (0, 50, "3d")]
)
def test_novatel_positions_that_were_set_are_not_measured(status: int, kind: int, fix: str) -> None:
    body = struct.pack("<II3dfI3f4s2f8B", status, kind, 47.5, 8.5, 952.5, 47.5, 61, 0.03, 0.04,
                       0.09, b"0001", 0.0, 0.0, 17, 16, 0, 0, 0, 0, 0, 0)  # fmt: skip
    (sample,) = novatel.decode(novatel.log(42, body, ms=5000))[1]
    assert isinstance(sample, NavSample)
    assert (sample.fix, sample.height_m) == (fix, 1000.0 if fix == "3d" else None)
    if fix in ("none", "time"):
        assert_no_position(sample)
    assert sample.velocity_ned_mps is None, "no BESTVEL came"


def test_novatel_solutions_without_any_log_of_sigmas_have_none() -> None:
    (sample,) = novatel.decode(novatel.pva(507, 360_018.0))[1]
    assert isinstance(sample, NavSample)
    assert sample.position is not None
    assert (sample.horizontal_sigma_m, sample.sigma_source, sample.satellites) == (
        None, "none", None
    )  # fmt: skip


def test_mavlink_markers_are_absent() -> None:
    def flown(*, fix: int = 3, ellipsoid_mm: int = 1_000_000, accuracy: int = 20, seen: int = 17):
        bus = mavlink.Bus()
        gps = bus.pack_message(mavlink.dialect.MAVLink_gps_raw_int_message(
            mavlink.BOOT_MS * 1000, fix, 475_000_000, 85_000_000, 952_500, 65_535, 65_535, 65_535,
            0, seen, ellipsoid_mm, accuracy, accuracy, accuracy, 0, 0,
        ))  # fmt: skip
        stream_bytes = bus.heartbeat() + bus.system_time() + gps + bus.position()
        (sample,) = mavlink.samples(stream_bytes)
        return sample

    assert_no_position(flown(fix=1))
    assert flown(fix=2).height_m is None
    assert flown(ellipsoid_mm=0).height_m is None, "a height above the sea is none above WGS 84"
    assert flown().height_m == pytest.approx(1000.0)
    unknown = flown(accuracy=0, seen=255)
    assert unknown.horizontal_sigma_m is unknown.vertical_sigma_m is unknown.satellites is None
    assert not math.isnan(unknown.latitude_deg)


def test_mavlink_before_the_gps_was_received_has_no_position() -> None:
    bus = mavlink.Bus()
    (sample,) = mavlink.samples(bus.heartbeat() + bus.system_time() + bus.position())
    assert_no_position(sample)
    assert sample.satellites is None
