"""MeasEpoch becomes RINEX: against the emulated truth, RTKLIB's convbin and pysbf2."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from daemon.postflight.exchange.rinex import RinexHeader, observation_text
from drivers.receivers.observations import ObservationCounts, ObservationEpoch
from drivers.receivers.septentrio.blocks import crc
from drivers.receivers.septentrio.observations import septentrio_observations
from tests.daemon.postflight.exchange.emulated_gnss import L1_HZ, C, meas_epoch, ranges
from tests.daemon.postflight.exchange.test_rinex import (
    START_NS,
    TOE_S,
    WEEK_NS,
    antenna_at,
    loaded,
    program,
    run,
)

pytestmark = pytest.mark.peer
HEAD = 8
BODY = HEAD + 12


def decoded(data: bytes) -> tuple[list[ObservationEpoch], ObservationCounts]:
    counts = ObservationCounts()
    return list(septentrio_observations(data, counts)), counts


def resealed(block: bytes, at: int, new: bytes) -> bytes:
    """The block with bytes replaced and its checksum right."""
    changed = block[:at] + new + block[at + len(new) :]
    return changed[:2] + struct.pack("<H", crc(changed[4:])) + changed[4:]


def test_signals_have_the_ranges_phases_and_dopplers_that_were_emulated() -> None:
    at = antenna_at(START_NS)
    (epoch,), counts = decoded(meas_epoch(at, START_NS, TOE_S))
    assert epoch.gps_ns == START_NS and (counts.unknown_signals, counts.unreadable) == (0, 0)
    tow_s = START_NS % WEEK_NS * 1e-9
    seen, later = ranges(at, tow_s, TOE_S), ranges(at, tow_s + 0.5, TOE_S)
    found = {(one.satellite, one.code): one for one in epoch.observations}
    assert {code for _, code in found} == {"1C", "2W", "5Q", "2C"}
    for prn, distance in seen.items():
        for k, (code, hertz) in enumerate((("1C", L1_HZ), ("2W", 1.2276e9), ("5Q", 1.17645e9))):
            one = found[f"G{prn:02d}", code]
            assert abs(one.pseudorange_m - distance - 12.345 * k) < 6e-4
            assert abs(one.phase_cycles - distance * hertz / C - 100 - prn) < 6e-4
            rate = (later.get(prn, distance) - distance) / 0.5
            assert abs(one.doppler_hz + rate * hertz / C) < 1.1e-4
    strengths = {code: one.strength_dbhz for (name, code), one in found.items() if name[0] == "G"}
    assert strengths == {"1C": 40.25, "2W": 31.5, "5Q": 44.0}
    assert {one.channel for (name, _), one in found.items() if name[0] == "R"} <= set(range(-7, 7))


def test_convbin_reads_the_same_values(tmp_path: Path) -> None:
    instants = [START_NS + k * 1_000_000_000 for k in range(5)]
    data = b"".join(meas_epoch(antenna_at(i), i, TOE_S) for i in instants)
    (tmp_path / "mosaic.sbf").write_bytes(data)
    run(
        program("convbin"), "-r", "sbf", "-v", "3.04", "-od", "-os", "-o", "theirs.obs",
        "-n", "theirs.nav", "mosaic.sbf", folder=tmp_path,
    )  # fmt: skip
    epochs, counts = decoded(data)
    assert (counts.epochs, counts.unknown_signals, counts.unreadable) == (5, 0, 0)
    text = observation_text(RinexHeader("SBF"), epochs, [], version="3.04").text
    (tmp_path / "ours.obs").write_text(text)
    ours, theirs = loaded(tmp_path / "ours.obs"), loaded(tmp_path / "theirs.obs")
    assert set(theirs.data_vars) <= set(ours.data_vars) and {"C1C", "L2W"} <= set(theirs.data_vars)
    ours = ours.sel(sv=theirs.sv, time=theirs.time)
    for name in theirs.data_vars:
        a, b = ours[name].values, theirs[name].values
        known = np.isfinite(b)
        # Its strengths of SBF are a quarter of a dB-Hz in its own unit of 0.001 (RTKLIB 2.4.3).
        factor = 250.0 if name.startswith("S") else 1.0
        assert known.any() and np.abs(a[known] - factor * b[known]).max() < 0.0011, name


def test_pysbf2_takes_the_blocks_apart_into_the_same_numbers() -> None:
    """Fields by another reader; the formulas of the guide are applied to them here again."""
    pysbf2 = pytest.importorskip("pysbf2")
    data = meas_epoch(antenna_at(START_NS), START_NS, TOE_S)
    parsed = pysbf2.SBFReader.parse(data)
    (epoch,), _ = decoded(data)
    ours = [one for one in epoch.observations if one.code == "1C"]
    assert len(ours) == parsed.N1 and parsed.TOW == START_NS % WEEK_NS // 1_000_000
    for k, one in enumerate(ours, 1):
        code_m = getattr(parsed, f"CodeMSB_{k:02d}") + getattr(parsed, f"CodeLSB_{k:02d}")
        assert abs(code_m - one.pseudorange_m) < 1e-6
        assert abs(getattr(parsed, f"Doppler_{k:02d}") - one.doppler_hz) < 1e-9
        assert getattr(parsed, f"CN0_{k:02d}") + 10.0 == one.strength_dbhz
        assert getattr(parsed, f"LockTime_{k:02d}") == one.lock_s == 60.0


def test_values_that_were_not_measured_are_none() -> None:
    good = meas_epoch(antenna_at(START_NS), START_NS, TOE_S)
    bad = resealed(good, BODY + 8, struct.pack("<iHbBH", -(2**31), 0, -128, 255, 0xFFFF))
    (epoch,), _ = decoded(bad)
    first, second, *_ = epoch.observations
    assert first.pseudorange_m is not None and first.lock_s == 0.0
    assert (first.phase_cycles, first.doppler_hz, first.strength_dbhz) == (None, None, None)
    assert second.phase_cycles is not None and second.doppler_hz is None
    bad = resealed(good, BODY + 3, struct.pack("<BI", 0, 0))
    (epoch,), _ = decoded(bad)
    assert [one.pseudorange_m for one in epoch.observations[:3]] == [None] * 3
    assert [one.phase_cycles for one in epoch.observations[:3]] == [None] * 3
    # Of the second signal: strength, code and Doppler.
    row = BODY + 20
    bad = resealed(resealed(good, row + 2, struct.pack("<BB", 255, 0b10000_100)), row + 6, b"\0\0")
    bad = resealed(bad, row + 10, b"\0\0")
    (epoch,), _ = decoded(bad)
    second = epoch.observations[1]
    assert (second.pseudorange_m, second.doppler_hz, second.strength_dbhz) == (None, None, None)


def test_half_cycles_extended_numbers_other_antennas_and_the_e6_component() -> None:
    good = meas_epoch(antenna_at(START_NS), START_NS, TOE_S, signals=((0, 0, L1_HZ, 45.0),))
    (epoch,), _ = decoded(resealed(good, BODY + 18, bytes([4])))
    assert epoch.observations[0].half_cycle and not epoch.observations[1].half_cycle
    (epoch,), counts = decoded(resealed(good, BODY + 1, bytes([0 | 1 << 5])))
    assert counts.other_antennas == 1 and counts.unknown_signals == 0
    # QZSS L1C, number 32, of SVID 183; L1 C/A of GPS is none of its signals.
    qzss = resealed(resealed(good, BODY + 1, bytes([31, 183])), BODY + 18, bytes([0 << 3]))
    (epoch,), _ = decoded(qzss)
    assert (epoch.observations[0].satellite, epoch.observations[0].code) == ("J03", "1L")
    (_,), counts = decoded(resealed(good, BODY + 2, bytes([183])))
    assert counts.unknown_signals == 1
    galileo = resealed(good, BODY + 1, bytes([19, 75]))
    (epoch,), _ = decoded(galileo)
    assert (epoch.observations[0].satellite, epoch.observations[0].code) == ("E05", "6C")
    (epoch,), _ = decoded(resealed(galileo, HEAD + 9, bytes([1 << 6])))
    assert epoch.observations[0].code == "6B"


@pytest.mark.parametrize(
    ("svid", "signal", "name"),
    [(1, 0, "G01"), (37, 0, "G37"), (38, 8, "R01"), (61, 8, "R24"), (63, 8, "R25"), (71, 17, "E01"),
     (106, 17, "E36"), (120, 24, "S20"), (140, 24, "S40"), (141, 28, "C01"), (180, 28, "C40"),
     (181, 6, "J01"), (191, 15, "I01"), (198, 24, "S41"), (215, 24, "S58"), (216, 15, "I08"),
     (223, 28, "C41"), (245, 28, "C63")],
)  # fmt: skip
def test_satellites_by_number(svid: int, signal: int, name: str) -> None:
    good = meas_epoch(antenna_at(START_NS), START_NS, TOE_S, signals=((0, 0, L1_HZ, 45.0),))
    (epoch,), _ = decoded(resealed(good, BODY + 1, bytes([signal, svid])))
    assert epoch.observations[0].satellite == name


def test_damaged_scrambled_and_undated_blocks_cost_themselves_only() -> None:
    good = meas_epoch(antenna_at(START_NS), START_NS, TOE_S)
    unknown_time = resealed(good, HEAD, b"\xff\xff\xff\xff")
    scrambled = resealed(good, HEAD + 9, bytes([1 << 7]))
    short = resealed(good, HEAD + 6, bytes([255]))
    small = resealed(good, HEAD + 7, bytes([4]))
    flipped = good[:60] + bytes([good[60] ^ 1]) + good[61:]
    epochs, counts = decoded(
        good + unknown_time + scrambled + short + small + flipped + good[:50] + good
    )
    assert len(epochs) == 2 == counts.epochs and counts.unreadable == 4


def test_the_end_of_the_week_is_refused_and_its_last_epoch_is_not() -> None:
    good = meas_epoch(antenna_at(START_NS), START_NS, TOE_S)
    last = resealed(good, HEAD, struct.pack("<I", 604_799_999))
    epochs, counts = decoded(last + resealed(good, HEAD, struct.pack("<I", 604_800_000)))
    assert len(epochs) == 1 and counts.unreadable == 1
    assert epochs[0].gps_ns == (START_NS // WEEK_NS) * WEEK_NS + 604_799_999 * 1_000_000


def test_no_content_of_a_sealed_block_raises() -> None:
    good = meas_epoch(antenna_at(START_NS), START_NS, TOE_S)
    random = np.random.default_rng(7)
    for _ in range(300):
        at = int(random.integers(HEAD, len(good) - 8))
        epochs, counts = decoded(resealed(good, at, random.bytes(8)))
        assert len(epochs) + counts.unreadable == 1
        for epoch in epochs:
            observation_text(RinexHeader("SBF"), [epoch], [], version="3.04")


def test_a_satellite_of_a_high_orbit_needs_all_bits_of_its_range() -> None:
    """38,000 km are beyond 2^35 mm."""
    good = meas_epoch(antenna_at(START_NS), START_NS, TOE_S)
    high, low = divmod(38_000_000_000, 1 << 32)
    (epoch,), _ = decoded(resealed(good, BODY + 3, struct.pack("<BI", high, low)))
    assert high == 8 and epoch.observations[0].pseudorange_m == pytest.approx(38_000_000.0)
