"""Every field of a gpsd report in the sample it becomes, and each limit on and beyond it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.contract import NavSample
from drivers.receivers.gpsd.reports import GpsdReports
from tests.drivers.test_gpsd import ATT, TPV, lines, samples


def one(**changes: Any) -> NavSample:
    (sample,) = samples({k: v for k, v in (TPV | changes).items() if v is not None})
    return sample


def fed(*reports: dict[str, Any], device: str = "") -> GpsdReports:
    decoder = GpsdReports("gnss", device)
    decoder.feed(lines(*reports), 7)
    return decoder


@pytest.mark.parametrize(
    ("changes", "fix", "height_m"),
    [
        ({"mode": 2}, "2d", None),
        ({"mode": 3}, "3d", 314.385),
        ({"mode": 3, "altHAE": None}, "2d", None),
        ({"mode": 4}, "3d", 314.385),
        ({"status": 5}, "dead-reckoning", 314.385),
        ({"status": 6}, "dead-reckoning", 314.385),
        ({"status": 4}, "3d", 314.385),
        ({"status": 5, "mode": 2}, "dead-reckoning", None),
    ],
)
def test_mode_and_status_are_the_fix(
    changes: dict[str, Any], fix: str, height_m: float | None
) -> None:
    sample = one(**changes)
    assert (sample.fix, sample.height_m) == (fix, height_m)
    assert sample.vertical_sigma_m == (None if height_m is None else 12.449)


@pytest.mark.parametrize(
    ("changes", "fix"),
    [
        ({"mode": 1}, "none"),
        ({"mode": 0}, "none"),
        ({"mode": None}, "none"),
        ({"status": 7}, "time"),
        ({"status": 8}, "none"),
        ({"time": None}, None),
        ({"lat": None}, None),
        ({"lon": None}, None),
        ({"lat": 90.1}, None),
        ({"lat": -90.1}, None),
        ({"lon": 360.1}, None),
        ({"lon": -180.1}, None),
    ],
)
def test_a_report_without_time_and_place_is_no_sample(
    changes: dict[str, Any], fix: str | None
) -> None:
    decoder = fed({k: v for k, v in (TPV | changes).items() if v is not None})
    assert (decoder.counters["samples"], decoder.counters["reports_without_fix"]) == (0, 1)
    assert decoder.fix == fix


@pytest.mark.parametrize(
    ("latitude", "longitude", "expected"),
    [(90, 360, 0), (-90, -180, -180), (0, 180, 180), (0, 180.5, -179.5), (0, 270, -90)],
)
def test_a_longitude_is_within_180_degrees(
    latitude: float, longitude: float, expected: float
) -> None:
    sample = one(lat=latitude, lon=longitude)
    assert (sample.latitude_deg, sample.longitude_deg) == (latitude, expected)


def test_speed_and_course_or_north_and_east_are_the_velocity() -> None:
    assert one().velocity_ned_mps == pytest.approx((0.0, 60.0, 1.5), abs=1e-12)
    assert one(track=30.0).velocity_ned_mps == pytest.approx((51.96152423, 30.0, 1.5))
    assert one(track=None).velocity_ned_mps is None
    assert one(track=None, speed=1).velocity_ned_mps is None
    assert one(track=None, speed=0).velocity_ned_mps == (0.0, 0.0, 1.5)
    assert one(climb=None).velocity_ned_mps == pytest.approx((0.0, 60.0, None), abs=1e-12)
    by_axes = {"speed": None, "climb": None, "velN": 3.0, "velE": 4.0, "velD": 0.5}
    assert one(**by_axes).velocity_ned_mps == (3.0, 4.0, 0.5)
    assert one(**(by_axes | {"velN": None})).velocity_ned_mps is None
    without_east = one(**(by_axes | {"velE": None}))
    assert (without_east.velocity_ned_mps, without_east.speed_sigma_mps) == (None, None)
    assert one().speed_sigma_mps == 0.28


@pytest.mark.parametrize(
    ("sigma", "known"), [(0, False), (0.001, True), (9_999.9, True), (10_000.0, False)]
)
def test_a_sigma_is_above_0_and_below_10_km(sigma: float, known: bool) -> None:
    sample = one(eph=sigma, epv=sigma)
    expected = sigma if known else None
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == (expected, expected)
    assert sample.sigma_source == ("receiver" if known else "none")


def test_a_sigma_of_the_speed_is_below_1000_mps_and_one_of_the_place_may_be_by_axes() -> None:
    assert (one(eps=999.9).speed_sigma_mps, one(eps=1000.0).speed_sigma_mps) == (999.9, None)
    assert one(eph=None, epx=3.0, epy=4.0).horizontal_sigma_m == 5.0
    assert one(eph=7.0, epx=3.0, epy=4.0).horizontal_sigma_m == 7.0
    assert one(eph=None, epx=3.0).horizontal_sigma_m is None
    assert one(eph=None, epy=3.0).horizontal_sigma_m is None


@pytest.mark.parametrize(
    ("leap_field", "leap", "source"),
    [(18, 18, "receiver"), (1, 1, "receiver"), (99, 99, "receiver"), (100, 18, "table"),
     (0, 18, "table"), (None, 18, "table")],
)  # fmt: skip
def test_leap_seconds_are_reported_or_of_the_table(
    leap_field: int | None, leap: int, source: str
) -> None:
    sample = one(leapseconds=leap_field)
    assert (sample.leap_seconds, sample.leap_source) == (leap, source)
    assert sample.gps_ns == one(leapseconds=18).gps_ns + (leap - 18) * 10**9
    decoder = fed({k: v for k, v in (TPV | {"leapseconds": leap_field}).items() if v is not None})
    assert decoder.counters["samples_by_leap_table"] == (source == "table")
    assert decoder.leap_seconds == (str(leap) if source == "receiver" else (
        "by our table, gpsd sends none"
    ))  # fmt: skip
    assert GpsdReports("gnss").leap_seconds == "unknown"


@pytest.mark.parametrize(("time_s", "is_known"), [("58.250", True), ("58.251", True),
    ("58.249", True), ("58.251000001", False), ("58.248999999", False)])  # fmt: skip
def test_an_attitude_is_of_the_instant_within_a_millisecond(time_s: str, is_known: bool) -> None:
    (sample,) = samples(ATT | {"time": f"2024-01-30T15:31:{time_s}Z"}, TPV)
    angles = (sample.roll_rad, sample.pitch_rad, sample.heading_rad)
    expected = (math.radians(-2.0), math.radians(3.0), math.pi) if is_known else (None,) * 3
    assert angles == pytest.approx(expected)


def test_reports_are_counted_by_class_and_what_is_none_is_bad() -> None:
    decoder = fed({"class": "SKY"}, {"class": "SKY"}, {"class": "GST"}, {"class": "ODD"}, TPV)
    assert dict(decoder.seen) == {"SKY": 2, "GST": 1, "other": 1, "TPV": 1}
    assert dict(decoder.counters) == {
        "samples": 1, "samples_by_leap_table": 0, "reports_without_fix": 0, "pps": 0,
    }  # fmt: skip
    decoder = fed({"class": "x" * 16}, {"class": "x" * 17}, {"class": 3}, {"device": "a"})
    assert (dict(decoder.seen), decoder.bad_messages) == ({"other": 1}, 3)
    decoder.feed(b"[1]\nno json\n\n  \r\n", 7)
    assert decoder.bad_messages == 5
    assert fed({"class": "PPS"}, {"class": "PPS"}).counters["pps"] == 2


def test_a_line_of_64_kib_is_read_and_a_longer_one_is_bad() -> None:
    report = lines({"class": "PPS"}).strip()
    for size, pps, bad in ((65_536, 1, 0), (65_537, 0, 1)):
        decoder = GpsdReports("gnss")
        decoder.feed(report.ljust(size) + b"\n", 7)
        assert (decoder.counters["pps"], decoder.bad_messages) == (pps, bad)
        assert decoder.bad_bytes == bad * size
    decoder = GpsdReports("gnss")
    decoder.feed(b"x" * 65_536, 7)
    assert decoder.bad_bytes == 0
    decoder.feed(b"x", 7)
    assert decoder.bad_bytes == 65_537
    decoder.feed(b"yz\n" + report + b"\n", 7)
    assert (decoder.bad_messages, decoder.bad_bytes, decoder.counters["pps"]) == (1, 65_539, 1)


def test_satellites_are_those_used_and_devices_those_listed() -> None:
    used = [{"used": True}, {"used": True}, {"used": False}, {"used": 1}, {}, 7]
    assert fed({"class": "SKY", "satellites": used}).satellites == 2
    assert fed({"class": "SKY", "satellites": used, "uSat": 9}).satellites == 9
    assert fed({"class": "SKY", "uSat": 1000}).satellites == 999
    assert fed({"class": "SKY", "uSat": -1}).satellites == 0
    listed = [{"path": f"/dev/{n}"} for n in range(18)] + [{"path": "late"}]
    assert len(fed({"class": "DEVICES", "devices": listed}).devices) == 16
    assert fed({"class": "DEVICES", "devices": [{"path": "x" * 90}, {}, 7]}).devices == ("x" * 80,)
    assert fed({"class": "VERSION", "release": "y" * 50}).release == "y" * 40
    assert fed({"class": "ERROR", "message": "z" * 130}).error == "z" * 120


def test_reports_of_another_device_are_left_alone() -> None:
    decoder = fed(TPV, TPV | {"device": "/dev/other"}, device="/dev/other")
    assert (decoder.counters["samples"], decoder.counters["other_devices"]) == (1, 1)
