"""The gpsd navigator: reports by the book, a hostile peer, and the real gpsd on recorded bytes."""

from __future__ import annotations

import json
import math
import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.contract import DeviceError, NavSample
from drivers.receivers.gpsd.navigator import GpsdNavigator
from drivers.receivers.gpsd.reports import MAX_LINE, GpsdReports
from drivers.receivers.ublox.decoder import UbxDecoder
from drivers.timescales.gps_time import SECOND_NS, UtcFields, utc_ns
from tests.drivers.fakes import RecordingSink
from tests.drivers.real_gpsd import PROGRAM, RealGpsd, running_gpsd
from tests.drivers.ubx_frames import without

EXCERPT = Path(__file__).parent / "data" / "ublox-neo-m8l-excerpt.ubx"
TPV: dict[str, object] = {
    "class": "TPV",
    "device": "/dev/ttyACM0",
    "mode": 3,
    "time": "2024-01-30T15:31:58.250Z",
    "leapseconds": 18,
    "lat": 48.7409856,
    "lon": 9.3117336,
    "altHAE": 314.385,
    "eph": 5.196,
    "epv": 12.449,
    "track": 90.0,
    "speed": 60.0,
    "climb": -1.5,
    "eps": 0.28,
}
ATT: dict[str, object] = {
    "class": "ATT",
    "device": "/dev/ttyACM0",
    "time": "2024-01-30T15:31:58.250Z",
    "roll": -2.0,
    "pitch": 3.0,
    "heading": 180.0,
}
VERSION = {"class": "VERSION", "release": "3.22"}
DEVICES = {"class": "DEVICES", "devices": [{"class": "DEVICE", "path": "/dev/ttyACM0"}]}


def lines(*reports: Mapping[str, object]) -> bytes:
    return b"".join(json.dumps(report).encode() + b"\r\n" for report in reports)


def samples(*reports: dict[str, object]) -> list[NavSample]:
    return GpsdReports("gnss").feed(lines(*reports), 7)


def test_a_report_becomes_a_sample_in_gps_time() -> None:
    (sample,) = samples({"class": "SKY", "nSat": 34, "uSat": 13}, ATT, TPV)
    utc = utc_ns(UtcFields(2024, 1, 30, 15, 31, 58, 250_000_000))
    assert utc is not None
    assert sample.gps_ns == utc + 18 * SECOND_NS
    assert (sample.time_valid, sample.leap_seconds, sample.fix) == (True, 18, "3d")
    assert (sample.latitude_deg, sample.longitude_deg) == (48.7409856, 9.3117336)
    assert (sample.height_m, sample.satellites, sample.mono_ns) == (314.385, 13, 7)
    assert (sample.horizontal_sigma_m, sample.vertical_sigma_m) == (5.196, 12.449)
    assert sample.velocity_ned_mps == pytest.approx((0.0, 60.0, 1.5), abs=1e-12)
    attitude = (sample.roll_rad, sample.pitch_rad, sample.heading_rad)
    assert attitude == pytest.approx((math.radians(-2), math.radians(3), math.pi))


def test_an_attitude_of_another_instant_is_not_taken() -> None:
    (sample,) = samples({**ATT, "time": "2024-01-30T15:31:58.150Z"}, TPV)
    assert sample.roll_rad is sample.pitch_rad is sample.heading_rad is None


@pytest.mark.trust
def test_without_leap_seconds_time_comes_from_the_table_and_reports_it() -> None:
    before = {key: value for key, value in TPV.items() if key != "leapseconds"}
    first, second, third = samples(before, TPV, before)
    assert [s.time_valid for s in (first, second, third)] == [True] * 3
    assert [s.leap_source for s in (first, second, third)] == ["table", "receiver", "receiver"]
    assert first.leap_seconds == 18
    assert first.gps_ns == second.gps_ns
    (old,) = samples({**before, "time": "2016-12-31T23:59:59.000Z"})
    assert old.leap_seconds == 17


@pytest.mark.parametrize(
    ("change", "fix"),
    [({"mode": 2}, "2d"), ({"status": 5}, "dead-reckoning"), ({"status": 3}, "3d")],
)
def test_the_fix_is_gpsds_value(change: dict[str, object], fix: str) -> None:
    assert [sample.fix for sample in samples({**TPV, **change})] == [fix]


@pytest.mark.parametrize(
    "change",
    [
        {"mode": 1},
        {"time": "yesterday"},
        {"time": "2024-02-30T00:00:00Z"},
        {"lat": "48"},
        {"lat": 91},
        {"lon": 10**400},
        {"lon": True},
        {"lat": float("nan")},
        {"mode": None},
    ],
)
def test_a_report_without_time_or_position_is_no_sample(change: dict[str, object]) -> None:
    reports = GpsdReports("gnss")
    assert reports.feed(lines({**TPV, **change}), 0) == []
    assert reports.counters["reports_without_fix"] == 1


@pytest.mark.trust
def test_what_is_not_reported_is_absent() -> None:
    bare = {key: TPV[key] for key in ("class", "mode", "time", "lat", "lon")}
    (sample,) = samples(bare)
    assert (sample.fix, sample.height_m, sample.satellites) == ("2d", None, None)
    assert sample.horizontal_sigma_m is sample.vertical_sigma_m is None
    assert sample.velocity_ned_mps is sample.speed_sigma_mps is None
    assert sample.sigma_source == "none"


@pytest.mark.trust
@pytest.mark.parametrize(("status", "fix"), [(7, "time"), (8, "none")])
def test_a_position_that_was_not_measured_is_none(status: int, fix: str) -> None:
    reports = GpsdReports("gnss")
    assert reports.feed(lines({**TPV, "status": status}), 0) == []
    assert reports.fix == fix


@pytest.mark.trust
def test_a_height_that_is_held_in_two_dimensions_is_absent() -> None:
    (sample,) = samples({**TPV, "mode": 2})
    assert (sample.fix, sample.height_m, sample.vertical_sigma_m) == ("2d", None, None)


def test_only_the_requested_device_is_read() -> None:
    reports = GpsdReports("gnss", "/dev/ttyACM0")
    found = reports.feed(lines({**TPV, "device": "/dev/ttyACM1"}, TPV), 0)
    assert len(found) == 1
    assert reports.counters["other_devices"] == 1


def test_a_line_without_end_takes_no_memory_and_the_next_is_read() -> None:
    reports = GpsdReports("gnss")
    for _ in range(40):
        assert reports.feed(b"[" * 50_000, 0) == []
        assert len(reports._pending) <= MAX_LINE
    assert len(reports.feed(b"\n" + lines(TPV), 0)) == 1
    assert reports.bad_bytes == 2_000_000
    assert reports.feed(b"[" * 60_000 + b"\n", 0) == [], "nested deeper than the interpreter goes"


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)


@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from(["TPV", "SKY", "ATT", "DEVICES", "VERSION", "ERROR", "PPS"]),
    changes=st.dictionaries(
        st.sampled_from([*TPV, *ATT, "satellites", "devices", "uSat", "message", "release"]), JSON
    ),
    noise=st.binary(max_size=60),
)
def test_whatever_a_report_holds_the_next_one_is_read(
    name: str, changes: dict[str, object], noise: bytes
) -> None:
    reports = GpsdReports("gnss")
    reports.feed(lines({**TPV, **ATT, **changes, "class": name}) + noise + b"\n", 0)
    assert len(reports.feed(lines(TPV), 0)) == 1


class StubGpsd:
    """Serves a script to every connection, one after the other, and then closes it."""

    def __init__(self, *scripts: bytes) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(10)
        self.port = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self.requests: list[bytes] = []
        self._scripts = scripts
        self._hold = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        for number, script in enumerate(self._scripts, 1):
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection:
                connection.settimeout(5)
                connection.sendall(lines(VERSION, DEVICES))
                self.requests.append(connection.recv(1000))
                connection.sendall(script)
                if number == len(self._scripts):
                    self._hold.wait(10)

    def close(self) -> None:
        self._hold.set()
        self._listener.close()
        self._thread.join(5)


def flown(navigator: GpsdNavigator, wanted: int) -> RecordingSink:
    """Run until so many samples have come."""
    recorder = RecordingSink()
    done = threading.Event()

    def watch(_: object) -> None:
        if sum(isinstance(record, NavSample) for record in recorder.records) >= wanted:
            done.set()

    recorder.stop = watch
    thread = threading.Thread(target=navigator.run, args=(recorder,))
    thread.start()
    try:
        assert done.wait(20), recorder.events
    finally:
        navigator.close()
        thread.join(5)
    return recorder


def test_a_gpsd_that_ends_is_found_again_and_watched_again() -> None:
    stub = StubGpsd(lines(TPV), lines(TPV, TPV))
    try:
        navigator = GpsdNavigator("gnss", {"port": stub.port, "device": "/dev/ttyACM0"})
        recorder = flown(navigator, 3)
    finally:
        stub.close()
    assert recorder.event_names == ["opened", "lost", "opened"]
    assert len(stub.requests) == 2
    watch = json.loads(stub.requests[1].removeprefix(b"?WATCH=").rstrip(b";\n"))
    assert watch == {"enable": True, "json": True, "pps": True, "device": "/dev/ttyACM0"}
    assert navigator.statistics()["opened"] == 2


@pytest.mark.parametrize(
    ("script", "device", "cure"),
    [
        (lines({"class": "DEVICES", "devices": []}), "", "has no receiver; name its port"),
        (b"", "/dev/ttyS9", "no receiver /dev/ttyS9; it has /dev/ttyACM0"),
        (b"", "", "sent nothing in 0.5 s"),
    ],
)
def test_binding_states_what_is_wrong_with_the_gpsd(script: bytes, device: str, cure: str) -> None:
    stub = StubGpsd(script)
    try:
        navigator = GpsdNavigator("gnss", {"port": stub.port, "device": device, "silence_s": 0.5})
        with pytest.raises(DeviceError, match=cure):
            navigator.bind()
    finally:
        stub.close()


def test_binding_without_a_gpsd_names_the_address() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = f"127.0.0.1:{listener.getsockname()[1]}"
    with pytest.raises(DeviceError, match=f"no gpsd answers at {port}"):
        GpsdNavigator("gnss", {"port": port}).bind()


@pytest.mark.parametrize("port", ["2947", "localhost:", "host:99999", ":2947", "host:x"])
def test_an_address_that_is_none_is_refused(port: str) -> None:
    assert GpsdNavigator.problems({"port": port}) == [
        f"port is {port!r}; host:port, as 127.0.0.1:2947"
    ]


@pytest.fixture
def real_gpsd() -> Iterator[RealGpsd]:
    """The real gpsd on a pseudo-terminal."""
    if PROGRAM is None:
        pytest.skip("gpsd is absent; install Debian's gpsd")
    with running_gpsd() as gpsd:
        yield gpsd


@pytest.mark.peer
def test_the_real_gpsd_states_what_our_own_decoder_reads(real_gpsd: RealGpsd) -> None:
    # gpsd reports HNR-PVT since 3.23, at 10 Hz and extrapolated; our decoder does not read it.
    recorded = without(EXCERPT.read_bytes(), 0x28, 0x00)
    own = [r for r in UbxDecoder("m8l").feed(recorded, 0) if isinstance(r, NavSample)]
    with real_gpsd.playing(recorded):
        navigator = GpsdNavigator("gnss", {"port": real_gpsd.address})
        recorder = flown(navigator, len(own) + 2)
    samples = [r for r in recorder.records if isinstance(r, NavSample)]
    found = [r for r in samples if r.time_valid]
    # gpsd writes milliseconds: the same epoch is the one within one of them.
    pairs = [(f, o) for f in found for o in own if abs(f.gps_ns - o.gps_ns) < 1_000_000]
    assert len(pairs) == len(found) >= len(own) - 1
    assert navigator.reports.release
    for gpsd, ours in pairs:
        assert gpsd.leap_seconds == 18
        assert gpsd.latitude_deg == pytest.approx(ours.latitude_deg, abs=1e-9)
        assert gpsd.longitude_deg == pytest.approx(ours.longitude_deg, abs=1e-9)
        assert gpsd.height_m == pytest.approx(ours.height_m, abs=6e-4)
        assert gpsd.fix == ours.fix
