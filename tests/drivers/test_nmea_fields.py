"""Fields of NMEA sentences as numbers, at the boundary of each."""

from __future__ import annotations

import pytest

from drivers.receivers.nmea.sentences import (
    angle_deg,
    day_number,
    day_of,
    dop_or_none,
    fields_of,
    is_proprietary,
    number,
    number_or_none,
    position_of,
    resolution_deg,
    time_of_day_ns,
)

SECOND_NS = 10**9


@pytest.mark.parametrize(
    ("text", "hemisphere", "limit", "expected"),
    [
        ("4730.000", "N", 90, 47.5),
        ("4730.000", "S", 90, -47.5),
        ("00830.60", "E", 180, 8.51),
        ("00830.60", "W", 180, -8.51),
        ("9000.000", "N", 90, 90.0),
        ("18000.00", "E", 180, 180.0),
        ("0000.000", "N", 90, 0.0),
        ("0059.999", "N", 90, 0.99998333),
        ("", "N", 90, None),
        ("4730.000", "", 90, None),
        ("", "", 90, None),
    ],
)
def test_an_angle_is_degrees_and_minutes(
    text: str, hemisphere: str, limit: float, expected: float | None
) -> None:
    found = angle_deg(text, hemisphere, limit)
    assert found == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize(
    ("text", "hemisphere", "limit"),
    [
        ("9000.001", "N", 90),
        ("18000.01", "E", 180),
        ("4760.000", "N", 90),
        ("4730.000", "X", 90),
        ("-4730.00", "N", 90),
        ("nan", "N", 90),
    ],
)
def test_what_is_no_angle_is_refused(text: str, hemisphere: str, limit: float) -> None:
    with pytest.raises(ValueError, match="is no"):
        angle_deg(text, hemisphere, limit)


def test_a_position_has_each_hemisphere_in_its_place() -> None:
    assert position_of(["4730.0", "N", "00830.0", "W"]) == (47.5, -8.5)
    assert position_of(["9000.0", "S", "18000.0", "E"]) == (-90.0, 180.0)
    assert position_of(["4730.0", "N", "", ""]) is None
    assert position_of(["", "", "00830.0", "W"]) is None
    for fields in (
        ["4730.0", "E", "00830.0", "W"],
        ["4730.0", "N", "00830.0", "S"],
        ["9001.0", "N", "00830.0", "E"],
        ["4730.0", "N", "18001.0", "E"],
    ):
        with pytest.raises(ValueError, match=r"hemisphere|is no angle"):
            position_of(fields)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("000000", (0, False)),
        ("010203", (3_723 * SECOND_NS, False)),
        ("235959.999999999", (86_399 * SECOND_NS + 999_999_999, False)),
        ("235960", (86_400 * SECOND_NS, True)),
        ("000000.25", (250_000_000, False)),
        ("000001.000000001", (SECOND_NS + 1, False)),
    ],
)
def test_a_time_of_day_is_exact(text: str, expected: tuple[int, bool]) -> None:
    assert time_of_day_ns(text) == expected


@pytest.mark.parametrize("text", ["240000", "006000", "000061", "", "0000", "00000a"])
def test_what_is_no_time_of_day_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is no time"):
        time_of_day_ns(text)


@pytest.mark.parametrize(
    ("text", "day"),
    [("060180", 0), ("070180", 1), ("060280", 31), ("060181", 366), ("311299", 7299),
     ("010100", 7300), ("311279", 36519)],
)  # fmt: skip
def test_a_year_from_80_on_lies_in_the_last_century(text: str, day: int) -> None:
    assert day_of(text) == day
    assert day_number(1980, 1, 7) == 1


@pytest.mark.parametrize("text", ["320180", "000180", "300223", "0601", ""])
def test_what_is_no_date_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is no date|out of range|must be in"):
        day_of(text)


def test_numbers_and_dilutions() -> None:
    assert (number("1.5"), number_or_none(" "), number_or_none(" 2 ")) == (1.5, None, 2.0)
    for text in ("nan", "1e9", "0x1", ""):
        with pytest.raises(ValueError, match=r"is no number|could not convert"):
            number(text)
    assert [dop_or_none(text) for text in ("", "0", "0.01", "1.2", "99.99")] == [
        *(None, None, 0.01, 1.2, None)
    ]
    assert resolution_deg("4717.1127") == pytest.approx(1e-4 / 60, rel=1e-12)
    assert resolution_deg("4717") == pytest.approx(1 / 60, rel=1e-12)
    assert fields_of(b"$GNTXT,01,hello*00\r\n") == ["GNTXT", "01", "hello"]
    assert is_proprietary(b"$PUBX,00") and not is_proprietary(b"$GPGGA,00")
