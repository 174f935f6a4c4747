"""Faults of emulated devices on real pseudo-terminals, read by a plain host."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial
from pyubx2 import UBX_PROTOCOL, UBXReader

from sim_hw.devices.device_loop import LineDevice
from sim_hw.devices.modbus_probe import ModbusProbe
from sim_hw.devices.pseudo_terminal import PseudoTerminal
from sim_hw.faults.channel import BytesDamage, Channel
from sim_hw.faults.faulty_line import FaultyWire, FaultyWorldClock
from sim_hw.faults.plan import PlannedFault
from sim_hw.receivers.emulated_receiver import ReceiverState
from sim_hw.receivers.ublox_receiver import UbloxReceiver
from sim_hw.world.world_clock import NS_PER_WEEK, WorldClock

pytestmark = pytest.mark.realtime


WITHIN_S = 20.0
STATE = ReceiverState(48.0, 11.0, 500.0, (60.0, 0.0, 0.0), 0.0, 0.0, 0.0)
POLL_REQUEST = bytes.fromhex("01 04 00 00 00 01 31 ca")


def planned(name: str, at_s: float, lasts_s: float | None = None, **more: object) -> PlannedFault:
    amount = more.get("amount", 0.0)
    assert isinstance(amount, float)
    return PlannedFault(name, "d", at_s, None, lasts_s, amount, str(more.get("topic", "")))


@contextmanager
def started(device: LineDevice, channel: Channel[bytes], line: PseudoTerminal) -> Iterator[None]:
    device.byte_filter = FaultyWire(device, channel, line)
    channel.begin(time.monotonic_ns())
    device.start()
    try:
        yield
    finally:
        device.close()


@contextmanager
def receiver(
    link: Path, *faults: PlannedFault, rate_hz: float = 20.0
) -> Iterator[tuple[UbloxReceiver, Channel[bytes]]]:
    channel = Channel(faults, BytesDamage(), seed=1)
    clock = FaultyWorldClock(WorldClock.from_wall_clock(), channel)
    line = PseudoTerminal(link)
    emulated = UbloxReceiver(clock, lambda _: STATE, rate_hz=rate_hz, chatter=False, line=line)
    with started(emulated, channel, line):
        yield emulated, channel


def read_until(port: str, enough: Callable[[bytes], bool]) -> bytes:
    """Read until there is enough."""
    data = b""
    deadline = time.monotonic() + WITHIN_S
    with serial.Serial(port, timeout=0.1) as host:
        while not enough(data):
            assert time.monotonic() < deadline, f"{len(data)} bytes came"
            data += host.read(4096)
    return data


def messages(data: bytes, identity: str) -> list[object]:
    found = (UBXReader.parse(frame) for frame in _frames(data))
    return [message for message in found if message.identity == identity]


def _frames(data: bytes) -> Iterator[bytes]:
    import io

    yield from (raw for raw, _ in UBXReader(io.BytesIO(data), protfilter=UBX_PROTOCOL) if raw)


def test_a_pulled_cable_takes_the_port_away_and_brings_it_back(tmp_path: Path) -> None:
    link = tmp_path / "gnss"
    with receiver(link, planned("cable-pulled", 1.0, 1.0)):
        deadline = time.monotonic() + WITHIN_S
        with serial.Serial(str(link), timeout=0.1) as host, pytest.raises(serial.SerialException):
            while time.monotonic() < deadline:
                host.read(4096)
        assert not link.exists()
        while not link.exists():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert b"\xb5\x62" in read_until(str(link), lambda data: len(data) > 500)


def test_a_mark_is_lost_alone(tmp_path: Path) -> None:
    link = tmp_path / "gnss"
    with receiver(link, planned("lost", 0.0, topic="mark")) as (emulated, _):

        def three(data: bytes) -> bool:
            if (
                not emulated.counts["marks"]
                or data.count(b"\xb5\x62\x01\x07") > emulated.counts["marks"]
            ):
                emulated.mark(emulated.clock.gps_ns(time.monotonic_ns()))
            return data.count(b"\xb5\x62\x0d\x03") >= 3

        data = read_until(str(link), three)
    counts = [message.count for message in messages(data, "TIM-TM2")]
    assert counts == list(range(counts[0], counts[0] + len(counts))) and counts[0] >= 2


def test_a_wrong_week_is_sent_and_then_the_right_one_again(tmp_path: Path) -> None:
    link = tmp_path / "gnss"
    with receiver(link, planned("wrong-week", 0.5, 1.0, amount=-1024.0)) as (emulated, _):
        week = emulated.clock.gps_ns(time.monotonic_ns()) // NS_PER_WEEK

        def weeks(data: bytes) -> list[int]:
            return [m.week for m in messages(data, "NAV-TIMEGPS")]

        data = read_until(
            str(link),
            lambda data: (
                len(data) > 2000
                and {week, week - 1024} <= set(weeks(data))
                and weeks(data)[-1] == week
            ),
        )
    assert set(weeks(data)) == {week, week - 1024}


def test_power_off_and_on_starts_the_count_again(tmp_path: Path) -> None:
    link = tmp_path / "gnss"
    channel = Channel([planned("power-cycle", 0.3, 0.3)], BytesDamage(), seed=1)
    line = PseudoTerminal(link)
    emulated = UbloxReceiver(
        WorldClock.from_wall_clock(),
        lambda _: STATE,
        rate_hz=20.0,
        chatter=False,
        first_edge_count=700,
        line=line,
    )
    with started(emulated, channel, line):
        deadline = time.monotonic() + WITHIN_S
        while not channel.occurrences:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        while not link.exists():
            assert time.monotonic() < deadline
            time.sleep(0.02)

        def marked(data: bytes) -> bool:
            if data and not emulated.counts["marks"]:
                emulated.mark(emulated.clock.gps_ns(time.monotonic_ns()))
            return b"\xb5\x62\x0d\x03" in data and data.count(b"\xb5\x62\x01\x07") > 3

        data = read_until(str(link), marked)
    assert [m.count for m in messages(data, "TIM-TM2")] == [1]


def test_a_late_answer_of_a_probe_comes_all_the_same(tmp_path: Path) -> None:
    channel = Channel([planned("late", 0.0, amount=0.6)], BytesDamage(), seed=1)
    line = PseudoTerminal(tmp_path / "probes")
    probe = ModbusProbe([lambda: 21.5], line=line)
    with started(probe, channel, line), serial.Serial(probe.port, timeout=WITHIN_S) as host:
        polled_s = time.monotonic()
        host.write(POLL_REQUEST)
        assert len(host.read(7)) == 7
        assert time.monotonic() - polled_s > 0.5


@pytest.mark.parametrize("name", ["corrupt", "truncated", "lost"])
def test_a_damaged_answer_is_followed_by_a_good_one(tmp_path: Path, name: str) -> None:
    channel = Channel([planned(name, 0.0)], BytesDamage(), seed=2)
    line = PseudoTerminal(tmp_path / "probes")
    probe = ModbusProbe([lambda: 21.5], line=line)
    good = probe.answer(POLL_REQUEST)
    with started(probe, channel, line), serial.Serial(probe.port, timeout=0.5) as host:
        host.write(POLL_REQUEST)
        assert host.read(7) != good
        host.reset_input_buffer()
        host.write(POLL_REQUEST)
        assert host.read(7) == good


def test_a_flood_is_noise_between_answers(tmp_path: Path) -> None:
    channel = Channel([planned("flooding", 0.0, 5.0)], BytesDamage(), seed=1)
    line = PseudoTerminal(tmp_path / "probes")
    probe = ModbusProbe([lambda: 21.5], line=line)
    with started(probe, channel, line):
        assert len(read_until(probe.port, lambda data: len(data) > 10_000)) > 10_000
