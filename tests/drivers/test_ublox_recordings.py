"""The navigator on whole recordings of gpsd, message by message against pyubx2's own reading."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest
from pyubx2 import ERR_IGNORE, UBX_PROTOCOL, UBXReader

from drivers.contract import DeviceError, NavSample, RawBytes
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.receivers.ublox.navigator import UbloxNavigator
from drivers.timescales.gps_time import WEEK_NS
from tests.drivers.fakes import RecordingSink
from tests.drivers.pty_line import PtyLine
from tests.drivers.ubx_frames import frame

RECORDINGS = Path(__file__).parent / "data" / "gpsd"
EXCERPT = Path(__file__).parent / "data" / "ublox-neo-m8l-excerpt.ubx"


def _theirs(path: Path, identity: str) -> list[Any]:
    with path.open("rb") as stream:
        reader = UBXReader(stream, protfilter=UBX_PROTOCOL, quitonerror=ERR_IGNORE)
        return [message for _, message in reader if message and message.identity == identity]


@pytest.mark.peer
@pytest.mark.parametrize(("name", "epochs"), [("ublox-neo-m8l", 19), ("ublox-zed-f9r", 30)])
def test_every_recorded_epoch_has_the_gps_time_of_its_nav_timegps(name: str, epochs: int) -> None:
    path = RECORDINGS / f"{name}.log"
    samples = [r for r in UbxDecoder(name).feed(path.read_bytes(), 0) if isinstance(r, NavSample)]
    assert len(samples) == epochs
    times = {
        m.iTOW: m.week * WEEK_NS + m.iTOW * 10**6 + m.fTOW for m in _theirs(path, "NAV-TIMEGPS")
    }
    for sample, pvt in zip(samples, _theirs(path, "NAV-PVT"), strict=True):
        # Two roads to the same instant: UTC with nano, and week with time of week. They differ by
        # the offset of the receiver's UTC from GPS beyond the leap seconds, some nanoseconds.
        assert abs(sample.gps_ns - times[pvt.iTOW]) <= 10
        assert sample.time_valid
        assert sample.leap_seconds == 18
        assert (sample.latitude_deg, sample.longitude_deg) == (pvt.lat, pvt.lon)
        assert sample.satellites == pvt.numSV


@pytest.mark.peer
def test_the_recorded_m8t_has_18_leap_seconds_and_no_damage() -> None:
    path = RECORDINGS / "u-blox-m8t-time.log"
    decoder = UbxDecoder("m8t")
    decoder.feed(path.read_bytes(), 0)
    assert decoder.leap_seconds == 18
    assert decoder.seen["NAV-TIMELS"] == len(_theirs(path, "NAV-TIMELS")) == 151
    assert decoder.bad_messages == 0


@pytest.mark.peer
def test_attitude_of_the_recorded_m8l_is_that_of_the_same_time_of_week() -> None:
    path = RECORDINGS / "ublox-neo-m8l.log"
    headings = {m.iTOW: m.heading for m in _theirs(path, "HNR-ATT")}
    samples = [r for r in UbxDecoder("m8l").feed(path.read_bytes(), 0) if isinstance(r, NavSample)]
    with_attitude = 0
    for sample, pvt in zip(samples, _theirs(path, "NAV-PVT"), strict=True):
        if sample.heading_rad is not None:
            with_attitude += 1
            assert sample.heading_rad * 57.29577951308232 == pytest.approx(headings[pvt.iTOW])
    assert with_attitude == 18, "all but the first, whose attitude lies before the recording"


def test_a_recording_played_over_a_line_comes_out_complete() -> None:
    recorded = EXCERPT.read_bytes()
    expected = [r.gps_ns for r in UbxDecoder("m8l").feed(recorded, 0) if isinstance(r, NavSample)]
    with PtyLine() as line:
        navigator = UbloxNavigator("m8l", {"port": line.near})
        recorder = RecordingSink()
        done, opened = threading.Event(), threading.Event()

        def watch(_: object) -> None:
            opened.set()
            got = [r for r in recorder.records if isinstance(r, NavSample)]
            if len(got) == len(expected):
                done.set()

        recorder.stop = watch
        thread = threading.Thread(target=navigator.run, args=(recorder,))
        thread.start()
        assert opened.wait(5)
        for at in range(0, len(recorded), 500):
            line.inject(recorded[at : at + 500])
        assert done.wait(10)
        navigator.close()
        thread.join(5)
    got = [r.gps_ns for r in recorder.records if isinstance(r, NavSample)]
    raw = b"".join(r.data for r in recorder.records if isinstance(r, RawBytes))
    assert got == expected
    assert raw == recorded[: len(raw)]
    assert navigator.statistics()["samples"] == len(expected)


@pytest.mark.parametrize(
    ("received", "cure"),
    [
        (b"", "nothing came"),
        (b"$GNRMC,,V,,,,,,,,,,N*4D\r\n" * 5, "sends text only"),
        (bytes(range(128, 256)) * 2, "makes no sense at 115200 bit/s"),
        (frame(0x01, 0x35, bytes(8)), "sent no NAV-PVT"),
    ],
)
def test_binding_states_what_is_wrong_with_the_receiver(received: bytes, cure: str) -> None:
    with PtyLine() as line:
        navigator = UbloxNavigator("gnss", {"port": line.near, "silence_s": 0.5})
        if received:
            threading.Timer(0.1, line.inject, (received,)).start()
        with pytest.raises(DeviceError, match=cure):
            navigator.bind()


def test_binding_lists_what_the_receiver_sends() -> None:
    with PtyLine() as line:
        navigator = UbloxNavigator("gnss", {"port": line.near})
        threading.Timer(0.1, line.inject, (EXCERPT.read_bytes()[:4000],)).start()
        found = navigator.bind()
        navigator.close()
    assert found["port"].startswith("/dev/")
    assert "NAV-PVT" in found["messages"]


def test_a_receiver_that_is_unplugged_is_found_again(tmp_path: Path) -> None:
    """The port is a link, as udev makes one: first to one pseudo-terminal, then to another."""
    link = tmp_path / "gnss"
    recorder = RecordingSink()
    names = {name: threading.Event() for name in ("opened", "lost")}
    again = threading.Event()

    def watch(_: object) -> None:
        for name in recorder.event_names:
            if name in names:
                names[name].set()
        if recorder.event_names.count("opened") == 2:
            again.set()

    recorder.stop = watch
    master, slave = os.openpty()
    link.symlink_to(os.ttyname(slave))
    navigator = UbloxNavigator("gnss", {"port": str(link)})
    thread = threading.Thread(target=navigator.run, args=(recorder,))
    thread.start()
    try:
        assert names["opened"].wait(5)
        os.close(slave)
        os.close(master)
        assert names["lost"].wait(5)
        link.unlink()
        with PtyLine() as line:
            link.symlink_to(line.near)
            assert again.wait(10)
            navigator.close()
            thread.join(5)
    finally:
        navigator.close()
        thread.join(5)
