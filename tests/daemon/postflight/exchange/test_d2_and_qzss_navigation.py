"""Ephemerides of geostationary BeiDou satellites (D2) and of QZSS: against RTKLIB's convbin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.receivers.gps_ephemeris import ephemerides_of
from drivers.receivers.septentrio.observations import (
    septentrio_pages,
    septentrio_subframes,
    septentrio_unread,
)
from drivers.receivers.ublox.observations import ublox_pages, ublox_subframes, ublox_unread
from tests.daemon.postflight.exchange.emulated_gnss import rawx, subframe_words
from tests.daemon.postflight.exchange.test_broadcast_ephemeris import (
    NOW,
    TOW,
    WEEK,
    found_in,
    joined,
    sbf,
    sfrbx,
    text_of,
    words_of,
)
from tests.daemon.postflight.exchange.test_rinex import (
    START_NS,
    TOE_S,
    antenna_at,
    program,
    run,
)
from tests.daemon.postflight.exchange.test_rinex_navigation import numbers

SPLIT = {"a1": (22, 18), "cuc": (18, 4), "e": (32, 22), "cic": (18, 8), "i0": (32, 11),
              "node_rate": (24, 5), "omega": (32, 5)}  # fmt: skip
"""Numbers in two pages: their bits, and how many are in the later page."""


def d2_pages(prn: int, *, sow: int = TOW - 14 - 30, pause_s: int = 0) -> list[int]:
    """Pages 1 to 10 of subframe 1 of D2, 300 bits each (BDS-SIS-ICD-B1I 3.0, figure 5-15).

    `pause_s` is lost before page 6.
    """
    toe = round((TOE_S - 8.0) / 8)
    split = {"a1": -1_298_765, "cuc": -30_003, "e": 0.0007 * 2**33, "cic": -71, "i0": 55_555_555,
             "node_rate": -1_191, "omega": -456_789_123}  # fmt: skip
    high, low = {}, {}
    for name, (bits, later) in SPLIT.items():
        value = round(split[name]) & ((1 << bits) - 1)
        high[name], low[name] = (value >> later, bits - later), (value & ((1 << later) - 1), later)
    contents = [
        ((1, 1), (9, 5), (3, 4), (WEEK - 1356, 13), (toe, 17), (-142, 10), (87, 10)),
        ((0x2AAAAAAAA, 40),),
        ((0, 38), (-1_234_567, 24), high["a1"]),
        (low["a1"], (-7, 11), (13, 5), (8_100, 16), high["cuc"]),
        (low["cuc"], (-123_456_789 - prn, 32), (44_004, 18), high["e"]),
        (low["e"], (6493.4 * 2**19, 32), high["cic"]),
        (low["cic"], (83, 18), (toe, 17), high["i0"]),
        (low["i0"], (55_005, 18), (-66_006, 18), high["node_rate"]),
        (low["node_rate"], (-987_654_321, 32), high["omega"]),
        (low["omega"], (-211, 14)),
    ]
    whole = []
    for page, content in enumerate(contents, start=1):
        at = sow + 3 * (page - 1) + (pause_s if page > 5 else 0)
        data, count = joined(
            (0b11100010010, 11), (0, 4), (1, 3), (at, 20), (page, 4), *content
        )  # fmt: skip
        data, left, bits = data << (224 - count), 224, 0
        for word in range(10):
            own = 26 if word == 0 else 22
            left -= own
            value = data >> left & ((1 << own) - 1)
            bits = bits << 30 | value << (30 - own) | ((1 << (30 - own)) - 1)
        whole.append(bits)
    return whole


def stream() -> bytes:
    """A minute of observations, D2 of C02, the legacy message of J03, and what is not read."""
    data = b""
    noise = np.random.default_rng(1)
    for second in range(0, 60, 6):
        instant = START_NS + second * 1_000_000_000
        data += rawx(antenna_at(instant), instant, TOE_S, noise)
        if second == 0:
            for page in d2_pages(2):
                data += sfrbx(3, 2, 1, words_of(page, 300, 30))
            for words in subframe_words(7, START_NS, TOE_S):
                data += sfrbx(5, 3, 0, [word << 6 for word in words])
            data += sfrbx(2, 3, 3, [0] * 8) + sfrbx(0, 3, 4, [0] * 10)
    return data


def records(text: str) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    name = ""
    for line in text.split("END OF HEADER")[1].splitlines()[1:]:
        if line[:1] in "CJ" and line[1:3].isdigit():
            name = line[:3]
            found[name] = numbers(line, 23)
        elif line[:1] == " " and name:
            found[name] += numbers(line, 4)
    return found


def ours(version: str = "3.04") -> str:
    legacy = list(ephemerides_of(ublox_subframes(stream()), WEEK))
    return text_of([*found_in(stream(), ublox_pages), *legacy], version)


@pytest.mark.peer
def test_d2_and_qzss_give_the_ephemerides_of_convbin(tmp_path: Path) -> None:
    (tmp_path / "in.bin").write_bytes(stream())
    at = f"{NOW:%Y/%m/%d %H:%M:%S}".split()
    run(
        program("convbin"), "-r", "ubx", "-v", "3.04", "-tr", *at, "-o", "theirs.obs", "-n",
        "theirs.nav", "in.bin", folder=tmp_path,
    )  # fmt: skip
    theirs = records((tmp_path / "theirs.nav").read_text())
    found = records(ours())
    assert found.keys() == theirs.keys() == {"C02", "J03"}
    for name, expected in theirs.items():
        # convbin 2.4.3 writes "more than 2 hours" for the flag 0 of QZSS (RINEX 3.04, table A12).
        values = found[name] if name == "C02" else found[name][:-1]
        near = np.isclose(values, expected[: len(values)], rtol=1e-11, atol=1e-25)
        assert near.all(), (name, [(k, values[k], expected[k]) for k in np.flatnonzero(~near)])


def test_version_4_names_the_messages_and_septentrio_gives_the_same() -> None:
    text = ours("4.00")
    assert "> EPH C02 D2\nC02 " in text and "> EPH J03 LNAV\nJ03 " in text
    recording = b"".join(sbf(4047, 142, words_of(page << 20, 320)) for page in d2_pages(2))
    for words in subframe_words(7, START_NS, TOE_S):
        recording += sbf(4066, 183, [word << 6 for word in words])
    assert found_in(recording, septentrio_pages) == found_in(stream(), ublox_pages)
    (one,) = ephemerides_of(septentrio_subframes(recording), WEEK)
    (other,) = ephemerides_of(ublox_subframes(stream()), WEEK)
    assert one == other and (one.system, one.satellite, one.values[-1]) == ("J", 3, 0.0)


def test_pages_of_different_frames_are_not_mixed() -> None:
    late = b"".join(sfrbx(3, 2, 1, words_of(p, 300, 30)) for p in d2_pages(2, pause_s=30))
    assert found_in(late, ublox_pages) == []
    missing = [page for k, page in enumerate(d2_pages(2)) if k != 4]
    assert (
        found_in(b"".join(sfrbx(3, 2, 1, words_of(p, 300, 30)) for p in missing), ublox_pages) == []
    )


def test_messages_that_are_not_read_are_named() -> None:
    assert ublox_unread(stream()) == ("GPS CNAV", "Galileo F/NAV")
    assert septentrio_unread(sbf(4022, 73, [0] * 8) + sbf(4093, 191, [0] * 10)) == (
        "Galileo F/NAV", "NavIC",
    )  # fmt: skip
