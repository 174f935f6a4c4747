"""The navigation message of GPS becomes RINEX: against RTKLIB's convbin, from real bytes too."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.exchange.rinex_navigation import navigation_text
from drivers.receivers.gps_ephemeris import (
    GpsEphemeris,
    Subframe,
    ephemerides_of,
    subframe_of_words,
)
from drivers.receivers.novatel.observations import novatel_subframes
from drivers.receivers.septentrio.observations import septentrio_subframes
from drivers.receivers.ublox.observations import ublox_subframes
from tests.daemon.postflight.exchange.emulated_gnss import (
    GPS_EPOCH,
    SQRT_A,
    gps_raw_ca,
    meas_epoch,
    novatel_range,
    rawephem,
    rawx,
    satellites,
    sfrbx,
    subframe_words,
)
from tests.daemon.postflight.exchange.test_rinex import (
    START_NS,
    TOE_S,
    WEEK_NS,
    antenna_at,
    program,
    run,
)

pytestmark = pytest.mark.peer
RECORDING = (
    Path(__file__).parents[5] / "shared" / "data" / "nav/gpsd-daemon/ublox-ned-m8t-sbfrx3.log"
)
MADE = datetime(2026, 1, 1, tzinfo=UTC)
WEEK = START_NS // WEEK_NS
Reader = Callable[[bytes], Iterator[Subframe]]


def numbers(line: str, first: int) -> list[float]:
    cells = [line[k : k + 19].strip() for k in range(first, len(line.rstrip()), 19)]
    return [float(cell.replace("D", "E").replace("-.", "-0.")) for cell in cells]


def records(text: str) -> dict[tuple[str, str], list[float]]:
    """Values by satellite and reference time."""
    found: dict[tuple[str, str], list[float]] = {}
    key = None
    for line in text.split("END OF HEADER")[1].splitlines()[1:]:
        if line.startswith(">"):
            continue
        if line[0] == "G":
            key = line[:3], line[4:23]
            found[key] = numbers(line, 23)
        elif line[0] == " " and key:
            found[key] += numbers(line, 4)
        else:
            key = None
    return found


def convbin(kind: str, data: bytes, folder: Path) -> dict[tuple[str, str], list[float]]:
    (folder / "in.bin").write_bytes(data)
    run(
        program("convbin"), "-r", kind, "-v", "3.04", "-o", "theirs.obs", "-n", "theirs.nav",
        "in.bin", folder=folder,
    )  # fmt: skip
    return records((folder / "theirs.nav").read_text())


def ours(reader: Reader, data: bytes, near_week: int, version: str = "3.04") -> str:
    found = list(ephemerides_of(reader(data), near_week))
    return navigation_text(found, version=version, made=MADE, comments=())


@pytest.mark.skipif(not RECORDING.exists(), reason="needs a recording in ../shared/data/nav")
def test_a_real_recording_gives_the_ephemeris_of_convbin(tmp_path: Path) -> None:
    data = RECORDING.read_bytes()
    theirs = convbin("ubx", data, tmp_path)
    found = records(ours(ublox_subframes, data, 2117))
    assert len(theirs) == 1 and same(found, theirs)
    # The same week is meant by a recording that is dated years off.
    assert records(ours(ublox_subframes, data, 2117 + 400)) == found
    assert records(ours(ublox_subframes, data, 2117 - 400)) == found


def same(found: dict, theirs: dict) -> bool:
    """Equal in the 12 digits that convbin writes."""
    return all(np.allclose(found[key], theirs[key], rtol=1e-11, atol=0.0) for key in theirs)


def emulated(kind: str) -> bytes:
    """A minute of observations and the subframes of all satellites in view."""
    stream = b""
    noise = np.random.default_rng(1)
    for second in range(0, 60, 6):
        instant = START_NS + second * 1_000_000_000
        at = antenna_at(instant)
        stream += {
            "ubx": lambda at=at, instant=instant: rawx(at, instant, TOE_S, noise),
            "nov": lambda at=at, instant=instant: novatel_range(at, instant, TOE_S),
            "sbf": lambda at=at, instant=instant: meas_epoch(at, instant, TOE_S),
        }[kind]()
        for prn in satellites():
            frames = subframe_words(prn, START_NS, TOE_S)
            if kind == "ubx":
                stream += sfrbx(prn, frames[second // 6 % 3])
            elif kind == "sbf":
                stream += gps_raw_ca(prn, instant, frames[second // 6 % 3])
            elif second == 0:
                stream += rawephem(prn, instant, TOE_S, frames)
    return stream


@pytest.mark.parametrize(
    ("kind", "reader"),
    [("ubx", ublox_subframes), ("nov", novatel_subframes)],
)
def test_emulated_messages_give_the_ephemerides_of_convbin(
    kind: str, reader: Reader, tmp_path: Path
) -> None:
    data = emulated(kind)
    found = records(ours(reader, data, WEEK))
    assert len(found) == len(satellites())
    theirs = convbin(kind, data, tmp_path)
    assert len(theirs) > 3 and theirs.keys() <= found.keys() and same(found, theirs)


def test_gps_raw_ca_gives_the_ephemerides_of_the_other_receivers() -> None:
    """convbin 2.4.3 decodes no ephemeris of it; pysbf2 takes the block apart."""
    sbf = ours(septentrio_subframes, emulated("sbf"), WEEK)
    assert records(sbf) == records(ours(ublox_subframes, emulated("ubx"), WEEK))
    pysbf2 = pytest.importorskip("pysbf2")
    words = subframe_words(7, START_NS, TOE_S)[0]
    parsed = pysbf2.SBFReader.parse(gps_raw_ca(7, START_NS, words))
    assert (parsed.identity, parsed.SVID, parsed.CRCPassed) == ("GPSRawCA", 7, 1)
    assert [word >> 6 & 0xFFFFFF for word in struct.unpack("<10I", parsed.NavBits)] == words


def test_the_elements_are_those_of_the_constellation() -> None:
    for one in ephemerides_of(ublox_subframes(emulated("ubx")), WEEK):
        node, inclination, anomaly = satellites()[one.satellite]
        values = one.values
        assert abs(np.sin(values[6] - anomaly)) < 3e-9 and abs(values[10] - SQRT_A) < 2e-6
        assert abs(np.sin(values[13] - node)) < 3e-9 and abs(values[15] - inclination) < 3e-9
        assert (one.week, one.toe_s, one.toc_s) == (WEEK, TOE_S, TOE_S)
        assert values[0] == (-1234 - one.satellite) * 2.0**-31 and values[23] == 4.0


def test_version_4_has_a_line_for_each_record() -> None:
    text = ours(ublox_subframes, emulated("ubx"), WEEK, version="4.00")
    assert text.startswith("     4.00           N: GNSS NAV DATA")
    assert text.count("> EPH G") == len(satellites()) and "> EPH G01 LNAV\nG01 " in text
    assert max(map(len, text.splitlines())) == 80


def subframes(prn: int = 7, toe_s: float = TOE_S, gps_ns: int = START_NS) -> list[Subframe]:
    made = [
        subframe_of_words(prn, [word << 6 for word in words])
        for words in subframe_words(prn, gps_ns, toe_s)
    ]
    return [one for one in made if one is not None]


def found_of(*given: Subframe) -> list[GpsEphemeris]:
    return list(ephemerides_of(given, WEEK))


def test_subframes_of_different_issues_are_not_mixed() -> None:
    one, two, three = subframes()
    assert len(found_of(three, one, two)) == 1 and found_of(one, two) == []
    # Issue of data 18 instead of 17 in one of them.
    for k, word, last_bit in ((0, 8, 8), (1, 3, 8), (2, 10, 8)):
        changed = [one, two, three]
        at = 240 - ((word - 1) * 24 + last_bit)
        changed[k] = Subframe(7, changed[k].bits ^ 3 << at)
        assert found_of(*changed) == [], k
    assert len(found_of(one, two, three, one, two, three)) == 1
    later = subframes(toe_s=TOE_S + 7200.0)
    assert len(found_of(one, two, three, *later)) == 2
    # The old issue stays complete until all three subframes of the new one have come.
    assert len(found_of(one, *subframes(prn=8), two, three)) == 2


def test_at_the_end_of_a_week_the_reference_time_is_in_the_next_one() -> None:
    sunday = (WEEK + 1) * WEEK_NS
    (one,) = found_of(*subframes(toe_s=0.0, gps_ns=sunday - 3_600_000_000_000))
    assert (one.week, one.toe_s) == (WEEK + 1, 0.0)
    text = navigation_text([one], version="3.04", made=MADE, comments=())
    at = GPS_EPOCH + timedelta(weeks=WEEK + 1)
    assert f"G07 {at:%Y %m %d %H %M %S}" in text
    (one,) = found_of(*subframes(toe_s=597_600.0, gps_ns=sunday + 600_000_000_000))
    assert one.week == WEEK


def test_long_fits_are_read_from_the_issue() -> None:
    one, two, three = subframes()
    longer = Subframe(7, two.bits | 1 << (240 - (9 * 24 + 17)))
    assert found_of(one, longer, three)[0].values[-1] == 6.0
    assert found_of(one, two, three)[0].values[-1] == 4.0


def test_damaged_and_foreign_messages_are_left_out() -> None:
    frames = subframe_words(7, START_NS, TOE_S)
    stream = b"".join(sfrbx(7, words) for words in frames)
    flipped = bytearray(stream)
    flipped[20] ^= 1
    assert len(list(ublox_subframes(bytes(flipped)))) == 2
    assert list(ublox_subframes(sfrbx(0, frames[0]) + sfrbx(33, frames[0]))) == []
    wrong_parity = bytearray(gps_raw_ca(7, START_NS, frames[0]))
    assert len(list(septentrio_subframes(bytes(wrong_parity)))) == 1
    assert subframe_of_words(7, [0] * 9) is None
    random = np.random.default_rng(3)
    for _ in range(200):
        noise = [
            Subframe(int(random.integers(1, 33)), int.from_bytes(random.bytes(30), "big"))
            for _ in range(6)
        ]
        navigation_text(found_of(*noise), version="3.04", made=MADE, comments=())


def test_a_clock_before_the_end_of_the_week_of_an_orbit_after_it_is_in_its_own_week() -> None:
    one = GpsEphemeris(7, WEEK + 1, 604_784.0, 0.0, (0.0,) * 29)
    text = navigation_text([one], version="3.04", made=MADE, comments=())
    at = GPS_EPOCH + timedelta(weeks=WEEK, seconds=604_784.0)
    assert f"G07 {at:%Y %m %d %H %M %S}" in text
