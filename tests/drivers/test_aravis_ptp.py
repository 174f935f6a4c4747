"""A head whose clock follows a real PTP master, ptp4l, over a network of two hosts."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.onboard.timing.gps_clock import GpsEstimate
from daemon.onboard.timing.ptp_time import PtpInstant, PtpTime
from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.cameras.aravis.ptp import PtpFeatures
from drivers.contract import DeviceEvent, Frame, LifeCycle, PtpReading, Record
from sim_hw.gige.gige_head import ExposureRequest, FrameSize, GigeHead, HeadIdentity, Pacing
from sim_hw.gige.ptp_slave import PtpSlave
from sim_hw.world.world_clock import FreeRunningClock
from tests.drivers.test_aravis_head import SHAPE, Memory
from tests.support.namespaces import Host, two_hosts
from tests.support.ptp_master import ptp_master

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytestmark = [pytest.mark.realtime, pytest.mark.timeout(120)]

NS = 1_000_000_000
WITHIN_S = 30.0
GPS_EPOCH_S, TAI_LESS_GPS_S, GPS_LESS_UTC_S = 315_964_800, 19, 18
ANOTHER = "aabbcc.fffe.ddeeff"


class Head:
    """An emulated head on one host, its driver on another, and what the driver yielded."""

    def __init__(self, address: str, *, ptp: PtpSlave | None, **section: object) -> None:
        self.emulated = GigeHead(
            HeadIdentity(address, "P-0", "Head", "Peer", "SU00"),
            FrameSize(SHAPE[1], SHAPE[0]),
            self._expose,
            lambda _mono_ns: 36.5,
            FreeRunningClock(offset_ns=10**12),
            packet_pacing=Pacing.for_receive_buffer(1 << 20),
            ptp=ptp,
        )
        settings = {"address": address, "ptp": True, "trigger_source": "action"}
        settings |= {"latch_interval_s": 0.5, "packet_size": 1400, **section}
        self.driver = AravisHead("SU00", settings, memory=Memory())
        self.starts_mono_ns: list[int] = []
        self.frames: list[Frame] = []
        self.readings: list[PtpReading] = []
        self.events: list[DeviceEvent] = []
        self._changed = threading.Condition()

    def _expose(self, request: ExposureRequest) -> NDArray[np.uint16]:
        self.starts_mono_ns.append(request.start_mono_ns)
        return np.zeros(SHAPE, np.uint16)

    def sink(self, record: Record) -> None:
        with self._changed:
            match record:
                case Frame():
                    self.frames.append(record)
                    self.driver.recycle(record.slot)
                case PtpReading():
                    self.readings.append(record)
                case DeviceEvent():
                    self.events.append(record)
            self._changed.notify_all()

    def wait(self, is_so: Callable[[], bool], what: str) -> None:
        with self._changed:
            assert self._changed.wait_for(is_so, WITHIN_S), (
                f"{what}: {[e.sentence for e in self.events]} {self.readings[-3:]}"
            )

    def wait_status(self, status: str) -> None:
        self.wait(lambda: bool(self.readings) and self.readings[-1].status == status, status)

    @contextmanager
    def running(self, on: Host | None = None, driver_on: Host | None = None) -> Iterator[Head]:
        thread = threading.Thread(target=self.driver.run, args=(self.sink,))
        _on(on, self.emulated.start)
        _on(driver_on, thread.start)
        try:
            self.wait(lambda: self.driver.state is LifeCycle.ACTIVE, "active")
            yield self
        finally:
            self.driver.close()
            thread.join(10)
            self.emulated.close()


def _on(host: Host | None, work: Callable[[], object]) -> None:
    if host is None:
        work()
    else:
        host.run(work)


def by_ptp(head: Head, *, utc_is_served: bool) -> tuple[PtpInstant | None, list[str], int]:
    """GPS time of the last frame's start by PTP, faults, and its error against truth, ns.

    The master serves CLOCK_REALTIME. Either the world's TAI is that, or its UTC.
    """
    gps_of_realtime_ns = (GPS_LESS_UTC_S if utc_is_served else -TAI_LESS_GPS_S) - GPS_EPOCH_S
    realtime_ns = time.time_ns() - time.monotonic_ns()

    def gps_ns(mono_ns: int) -> int:
        return mono_ns + realtime_ns + gps_of_realtime_ns * NS

    ptp, now_ns = PtpTime(), head.readings[-1].mono_ns
    for reading in [r for r in head.readings if r.status == "Slave"][-5:]:
        ptp.read(reading)
    for frame in head.frames:
        assert frame.device_clock_ns is not None
        assert frame.device_clock_mono_ns is not None
        assert frame.latch_sigma_ns is not None
        reference = GpsEstimate(gps_ns(frame.device_clock_mono_ns), 1_000, False)
        ptp.compare_latch(
            "SU00", frame.device_clock_ns, reference, frame.latch_sigma_ns, mono_ns=now_ns
        )
    last = head.frames[-1]
    assert last.device_ns is not None
    found = ptp.at("SU00", last.device_ns, now_ns)
    faults = [event.name for event in ptp.events(now_ns) if event.is_fault]
    truth_ns = gps_ns(head.starts_mono_ns[-1])
    return found, faults, 0 if found is None else found.gps_ns - truth_ns


def test_a_head_follows_ptp4l_and_exposes_at_the_masters_time(tmp_path: Path) -> None:
    with two_hosts() as (one, two):
        slave = PtpSlave(two.address, 0x0011_22FF_FE33_4455, drift_ppm=20.0)
        head = Head(two.address, ptp=slave)
        with ptp_master(one, tmp_path / "first") as master, head.running(two, one):
            head.wait_status("Slave")
            assert head.readings[-1].grandmaster == master.grandmaster
            ordered_ns: list[int] = []
            for number in range(1, 6):
                latches = head.driver.statistics()["latches"]
                head.wait(
                    lambda latches=latches: head.driver.statistics()["latches"] > latches, "latch"
                )
                # What the master shows in 0.2 s: nothing is asked of the head's clock.
                ordered_ns.append(time.time_ns() + NS // 5)
                one.run(lambda: head.driver.send_action_command(ordered_ns[-1]))
                head.wait(lambda number=number: len(head.frames) >= number, "frame")
            errors_ns = [
                abs(frame.device_ns - at_ns)
                for frame, at_ns in zip(head.frames, ordered_ns, strict=True)
                if frame.device_ns is not None
            ]
            assert len(errors_ns) == 5
            assert sorted(errors_ns)[2] < 2_000_000, "the start is stamped where it was ordered"
            offsets = [r.offset_ns for r in head.readings if r.status == "Slave"]
            assert all(each is not None and abs(each) < NS for each in offsets)

            found, faults, error_ns = by_ptp(head, utc_is_served=False)
            assert faults == []
            assert found is not None
            assert found.sigma_ns < 2_000_000
            assert abs(error_ns) <= 3 * found.sigma_ns

            master.announce_tai()
            found, faults, _ = by_ptp(head, utc_is_served=True)
            assert (found, faults) == (None, ["ptp-utc"])


def test_a_master_that_ends_and_another_that_follows_are_reported(tmp_path: Path) -> None:
    with two_hosts() as (one, two):
        slave = PtpSlave(two.address, 0x0011_22FF_FE33_4455)
        head, ptp = Head(two.address, ptp=slave), PtpTime()
        with head.running(two, one):
            with ptp_master(one, tmp_path / "first"):
                head.wait_status("Slave")
            head.wait_status("Listening")
            assert head.driver.statistics()["ptp_not_slave"] >= 1
            with ptp_master(one, tmp_path / "second", identity=ANOTHER):
                head.wait_status("Slave")
        assert head.readings[-1].grandmaster == ANOTHER.replace(".", "")
        faults = []
        for reading in head.readings:
            ptp.read(reading)
            faults += [e.name for e in ptp.events(reading.mono_ns) if e.is_fault]
        assert "ptp-not-slave" in faults
        assert "ptp-grandmaster-changed" in faults


def test_a_head_whose_ptp_stays_disabled_is_counted() -> None:
    head = Head("127.77.9.1", ptp=None)
    with head.running():
        head.wait(lambda: len(head.readings) >= 2, "readings")
    assert {reading.status for reading in head.readings} == {"Disabled"}
    assert head.readings[0].grandmaster == ""
    assert head.driver.statistics()["ptp_not_slave"] == len(head.readings)


def test_a_head_without_ptp_is_refused_with_the_setting() -> None:
    class NoFeatures:
        def first_available(self, names: object) -> None:
            return None

        def kind(self, name: str) -> None:
            return None

    # Only the used features of a camera exist.
    features = PtpFeatures(NoFeatures())  # type: ignore[arg-type]
    assert "set ptp = false" in features.enable()
    reading = features.read("SU00", 5)
    assert (reading.status, reading.offset_ns, reading.grandmaster) == ("unreadable", None, "")
