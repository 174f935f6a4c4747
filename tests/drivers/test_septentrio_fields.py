"""Every field of an SBF block in the record it becomes, and each limit on and beyond it."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from drivers.contract import EventMark, NavSample
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.timescales.gps_time import WEEK_NS
from tests.drivers.test_septentrio import (
    MS,
    UNKNOWN,
    WEEK,
    attitude,
    block,
    decode,
    event,
    marks,
    pvt,
    receiver_time,
    samples,
)

PVT = {
    "mode": 4, "error": 0, "latitude": math.radians(47.5), "longitude": math.radians(8.5),
    "height": 1000.0, "undulation": 47.5, "north": 60.0, "east": 3.0, "up": 1.0, "course": 2.9,
    "bias_ms": 0.25, "drift": 0.1, "system": 0, "datum": 0, "satellites": 17,
}  # fmt: skip


def solution(tow_ms: int, **changes: Any) -> bytes:
    body = struct.pack("<BB3d5fdf4BHHIB", *(PVT | changes).values(), 0, 0, 0, 0, 0)
    return block(4007, body, tow_ms=tow_ms)


def one(**changes: Any) -> NavSample:
    return samples(solution(1000, **changes) + solution(1200))[0]


def dilution(tow_ms: int, horizontal: int, vertical: int) -> bytes:
    body = struct.pack("<BB4H2f", 17, 0, 150, 60, horizontal, vertical, 0.0, 0.0)
    return block(4001, body, tow_ms=tow_ms)


def inertial(
    tow_ms: int,
    parts: int = 0,
    values: tuple[float, ...] = (),
    *,
    accuracy: int = 30,
    error: int = 0,
) -> bytes:
    head = struct.pack("<BBHHdddfHHBBH", 4, error, 0, 0, math.radians(47.5), math.radians(8.5),
                       1000.0, 47.5, accuracy, 10, 0, 0, parts)  # fmt: skip
    return block(4226, head + struct.pack(f"<{len(values)}f", *values), tow_ms=tow_ms)


@pytest.mark.parametrize(
    ("mode", "fix", "height_m"),
    [
        (0, "none", None),
        (1, "3d", 1000.0),
        (3, "time", None),
        (4, "3d", 1000.0),
        (0x0F, "3d", 1000.0),
        (0x84, "2d", None),
        (0x44, "3d", 1000.0),
    ],
)
def test_the_mode_is_the_fix(mode: int, fix: str, height_m: float | None) -> None:
    sample = one(mode=mode)
    assert (sample.fix, sample.height_m) == (fix, height_m)
    assert (sample.latitude_deg is not None) is (fix in ("2d", "3d"))


@pytest.mark.parametrize("absent", ["latitude", "longitude", "height"])
def test_a_solution_without_a_coordinate_is_none(absent: str) -> None:
    sample = one(**{absent: UNKNOWN})
    assert (sample.fix, sample.latitude_deg, sample.time_valid) == ("none", None, False)
    assert sample.velocity_ned_mps is None


def test_velocity_satellites_and_bias_that_are_not_there_stay_unknown() -> None:
    assert one().velocity_ned_mps == (60.0, 3.0, -1.0)
    assert one(up=UNKNOWN).velocity_ned_mps == (60.0, 3.0, None)
    assert one(north=UNKNOWN).velocity_ned_mps is None
    assert one(east=UNKNOWN).velocity_ned_mps is None
    assert (one(satellites=254).satellites, one(satellites=255).satellites) == (254, None)
    unbiased = one(bias_ms=UNKNOWN)
    assert (unbiased.fix, unbiased.time_valid) == ("3d", False)
    assert unbiased.gps_ns == WEEK * WEEK_NS + 1000 * MS
    assert one(bias_ms=-0.5).gps_ns == WEEK * WEEK_NS + 1000 * MS + 500_000


@pytest.mark.parametrize(
    ("changes", "is_place"),
    [
        ({"latitude": math.pi / 2}, True),
        ({"latitude": -math.pi / 2}, True),
        ({"latitude": math.nextafter(math.pi / 2, 2)}, False),
        ({"longitude": math.tau}, True),
        ({"longitude": -math.tau}, True),
        ({"longitude": math.nextafter(math.tau, 7)}, False),
    ],
)
def test_a_place_lies_between_the_poles_and_within_360_degrees(
    changes: dict[str, float], is_place: bool
) -> None:
    decoder, records = decode(solution(1000, **changes) + solution(1200) + solution(1400))
    assert (decoder.bad_messages == 0) is is_place
    assert len(records) == (3 if is_place else 1)


@pytest.mark.parametrize(
    ("horizontal", "vertical", "sigmas_m", "source"),
    [
        (80, 120, (4.0, 6.0), "dop"),
        (80, 0, (4.0, None), "dop"),
        (0, 120, (None, None), "none"),
    ],
)
def test_without_accuracies_five_metres_times_the_dilution_are_the_sigma(
    horizontal: int, vertical: int, sigmas_m: tuple[float | None, float | None], source: str
) -> None:
    data = solution(1000) + dilution(1000, horizontal, vertical) + solution(1200)
    sample = samples(data)[0]
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == pytest.approx(sigmas_m)
    assert (sample.sigma_source, one().sigma_source) == (source, "none")
    assert samples(pvt(1000) + pvt(1200))[0].sigma_source == "receiver"


def test_covariances_that_are_in_error_or_unknown_are_not_used() -> None:
    def covariances(number: int, error: int, *values: float) -> bytes:
        return block(number, struct.pack("<BB10f", 4, error, *values, *[0] * 7), tow_ms=1000)

    for error, last in ((1, 81e-4), (0, UNKNOWN)):
        position = covariances(5906, error, 9e-4, 16e-4, last)
        speed = covariances(5908, error, 9e-4, 16e-4, last)
        sample = samples(solution(1000) + position + speed + solution(1200))[0]
        assert (sample.horizontal_sigma_m, sample.speed_sigma_mps) == (None, None)


def test_an_epoch_is_reported_once_and_never_without_its_solution() -> None:
    first = solution(1000) + attitude(1000)
    second = solution(1200) + attitude(1200)
    decoder, records = decode(first + second + attitude(1200) + solution(1200))
    assert [r.gps_ns - WEEK * WEEK_NS for r in records] == [999_750_000, 1_199_750_000]
    assert decoder.counters["samples"] == 2
    decoder, records = decode(attitude(1000) + solution(1200) + solution(1400))
    assert [r.gps_ns - WEEK * WEEK_NS for r in records] == [1_199_750_000, 1_399_750_000]
    assert decoder.counters["samples"] == 2


@pytest.mark.parametrize(("later_ms", "count"), [(9_999, 0), (10_000, 1), (10_001, 1)])
def test_solutions_are_reported_again_10_s_after_the_last_inertial_one(
    later_ms: int, count: int
) -> None:
    decoder = SbfDecoder("sept")
    decoder.feed(solution(900) + inertial(1000), 0)  # with the bias of the solution before
    emitted = decoder.feed(solution(1000 + later_ms) + solution(200_000), 0)
    at_ns = WEEK * WEEK_NS + (1000 + later_ms) * MS - 250_000
    assert (at_ns in [record.gps_ns for record in emitted]) is bool(count)


def test_an_inertial_solution_has_its_own_accuracy_where_no_deviations_come() -> None:
    (sample,) = samples(inertial(1000))
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == pytest.approx((0.3, 0.3))
    assert (sample.speed_sigma_mps, sample.velocity_ned_mps) == (None, None)
    (unknown,) = samples(inertial(1000, accuracy=0xFFFF))
    assert (unknown.horizontal_sigma_m, unknown.sigma_source) == (None, "none")
    assert samples(inertial(1000, error=1)) == []
    deviations = (0.03, 0.04, 0.09)
    (known,) = samples(inertial(1000, 0b1, deviations))
    assert (known.horizontal_sigma_m, known.vertical_sigma_m) == pytest.approx((0.05, 0.09))
    (speeds,) = samples(inertial(1000, 0b10000, (0.02, 0.03, 0.06)))
    assert speeds.speed_sigma_mps == pytest.approx(0.07)
    (angles,) = samples(inertial(1000, 0b10, (359.0, -2.0, 1.5)))
    assert (angles.roll_rad, angles.pitch_rad, angles.heading_rad) == (
        math.radians(1.5), math.radians(-2.0), math.radians(359.0),
    )  # fmt: skip
    (after_unused,) = samples(inertial(1000, 0b1100, (1.0, 1.0, 1.0, 3.0, 60.0, 1.0)))
    assert after_unused.velocity_ned_mps == (60.0, 3.0, -1.0)
    (incomplete,) = samples(inertial(1000, 0b1000, (3.0, UNKNOWN, 1.0)))
    assert incomplete.velocity_ned_mps is None


@pytest.mark.parametrize(
    ("leap", "level", "known"),
    [(0, 3, 0), (99, 3, 99), (100, 3, None), (-1, 3, None), (18, 2, None), (18, 1, None)],
)
def test_leap_seconds_count_from_a_clock_that_is_set(
    leap: int, level: int, known: int | None
) -> None:
    assert decode(receiver_time(leap=leap, level=level))[0].leap_seconds == known


def test_a_mark_is_offset_less_bias_with_a_count_that_is_no_witness() -> None:
    mark = marks(event(offset_s=2.5e-4, bias_s=1e-3))[0]
    assert mark.gps_ns == WEEK * WEEK_NS + 100_000 * MS + 250_000 - 1_000_000
    assert (mark.count, mark.count_bits, mark.channel, mark.mono_ns) == (1, 0, 1, 77)
    (plain,) = SbfDecoder("sept").feed(event(age_s=3), 0)
    assert isinstance(plain, EventMark)
    assert plain.accuracy_ns == 100 + 3 * 100


def test_edges_are_counted_by_kind() -> None:
    decoder, _ = decode(event() + event(100_001, polarity=1) + event(100_002, polarity=1))
    assert (decoder.counters["marks"], decoder.counters["marks_other_edge"]) == (1, 2)
    assert decoder.other_edges == 2
    decoder.feed(event(100_003), 0)
    assert (decoder.counters["marks"], decoder.other_edges) == (2, 0)
    falling = SbfDecoder("sept", edge="falling")
    assert falling.feed(event(), 0) == []
    assert len(falling.feed(event(100_001, polarity=1), 0)) == 1


@pytest.mark.parametrize(("beyond_ns", "is_valid"), [(0, True), (1, False)])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_mark_lies_within_an_hour_of_the_last_epoch(
    side: int, beyond_ns: int, is_valid: bool
) -> None:
    emitted = solution(4_000_000, bias_ms=0.0) + solution(4_000_200, bias_ms=0.0)
    at_ms = 4_000_200 + side * 3_600_000
    decoder, records = decode(emitted + event(at_ms, side * beyond_ns * 1e-9))
    assert [r.time_valid for r in records if isinstance(r, EventMark)] == [is_valid]
    assert decoder.counters["marks_far"] == (not is_valid)


def test_a_lost_mark_is_counted_only_where_its_input_is_known() -> None:
    def position(tow_ms: int) -> bytes:
        return pvt(tow_ms, number=4038)

    assert decode(position(1000))[0].counters["marks_lost"] == 0
    one_input = event(1000) + position(2000) + position(2000) + position(3000)
    assert decode(one_input)[0].counters["marks_lost"] == 2
    two_inputs = event(1000) + event(1100, source=2) + position(2000)
    assert decode(two_inputs)[0].counters["marks_lost"] == 0
    two_edges = event(1000) + event(1100, polarity=1) + position(2000)
    assert decode(two_edges)[0].counters["marks_lost"] == 0


def test_a_block_without_time_from_a_receiver_just_switched_on_is_no_fix() -> None:
    decoder, records = decode(pvt(0xFFFFFFFF))
    assert (records, decoder.fix, decoder.satellites) == ([], "none", 0)
    decoder, _ = decode(attitude(0xFFFFFFFF))
    assert (decoder.fix, decoder.satellites) == (None, None)
    assert dict(decoder.seen) == {"AttEuler": 1}
    assert decoder.counters["marks_without_time"] == 0
