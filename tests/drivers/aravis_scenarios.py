"""What happens to an Aravis head and to its fake camera, each printed as a JSON object.

Run as a program of its own, one scenario a run, so that it can live in a network namespace where
port 3956 is free and discovery reaches nobody. The tests are in test_aravis_fake_camera.py.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import mmap
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.cameras.aravis.gvcp import control_privilege
from drivers.contract import (
    CHUNK_ALLOWANCE_NBYTES,
    DeviceError,
    DeviceEvent,
    Frame,
    LifeCycle,
    Record,
)
from tests.support.stopwatch import Stopwatch

ADDRESS = "127.0.0.1"
FAKE_CAMERA = "arv-fake-gv-camera-0.8"
SIZE = 512
NBYTES = SIZE * SIZE * 2
UNTOUCHED = 0xA5
EXPOSURE_US = 2000.0


class Memory:
    """Slots in an anonymous mapping, filled with a pattern no frame has."""

    def __init__(self, slot_count: int = 4) -> None:
        self.slot_count = slot_count
        self.slot_nbytes = NBYTES + CHUNK_ALLOWANCE_NBYTES
        mapping = mmap.mmap(-1, slot_count * self.slot_nbytes)
        self.slots = np.frombuffer(mapping, np.uint8).reshape(slot_count, self.slot_nbytes)
        self.slots[:] = UNTOUCHED

    def address(self, slot: int) -> int:
        return int(self.slots[slot].ctypes.data)

    def pixels(self, slot: int) -> np.ndarray[Any, np.dtype[np.uint16]]:
        return self.slots[slot, :NBYTES].view(np.uint16).reshape(SIZE, SIZE)


class Flight:
    """A head in its thread; what it yielded, with the time of arrival since `start`."""

    def __init__(self, *, recycle: bool = True, slot_count: int = 4, **more: object) -> None:
        self.memory = Memory(slot_count)
        section = {
            "address": ADDRESS,
            "trigger_source": "software",
            "exposure_time_us": EXPOSURE_US,
            **more,
        }
        self.head = AravisHead("SU00", section, memory=self.memory)
        self.recycle = recycle
        self.frames: list[Frame] = []
        self.pictures: list[np.ndarray[Any, np.dtype[np.uint16]]] = []
        self.events: list[tuple[float, DeviceEvent]] = []
        self.states_at_opened: list[str] = []
        self.start = time.monotonic()
        self.changed = threading.Condition()
        self.thread = threading.Thread(target=self.head.run, args=(self.sink,))

    def sink(self, record: Record) -> None:
        with self.changed:
            if isinstance(record, Frame):
                self.frames.append(record)
                self.pictures.append(self.memory.pixels(record.slot).copy())
                if self.recycle:
                    self.head.recycle(record.slot)
            elif isinstance(record, DeviceEvent):
                self.events.append((time.monotonic() - self.start, record))
                if record.name == "opened":
                    self.states_at_opened.append(self.head.state.value)
            self.changed.notify_all()

    def wait(self, true: Callable[[], bool], timeout_s: float) -> bool:
        with self.changed:
            return self.changed.wait_for(true, timeout_s)

    def wait_event(self, name: str, times: int, timeout_s: float) -> bool:
        return self.wait(lambda: self.names.count(name) >= times, timeout_s)

    def wait_active(self) -> None:
        deadline = time.monotonic() + 10
        pause = threading.Event()
        while self.head.state is not LifeCycle.ACTIVE and time.monotonic() < deadline:
            pause.wait(0.01)

    @property
    def names(self) -> list[str]:
        return [event.name for _, event in self.events]

    def expose(self, times: int) -> list[float]:
        """Trigger, wait for the frame; ms from the end of the exposure to the frame."""
        found = []
        pause = threading.Event()
        for _ in range(times):
            pause.wait(0.06)
            expected = len(self.frames) + 1
            before = time.monotonic()
            self.head.trigger()
            if self.wait(lambda n=expected: len(self.frames) >= n, 2):
                arrived = self.frames[-1].mono_ns * 1e-9
                found.append((arrived - before) * 1e3 - EXPOSURE_US * 1e-3)
        return found


@contextlib.contextmanager
def fake_camera(*more: str) -> Iterator[subprocess.Popen[bytes]]:
    """Aravis' own fake camera, answering."""
    with subprocess.Popen([FAKE_CAMERA, "-i", ADDRESS, "-s", "T1", *more]) as process:
        try:
            deadline = time.monotonic() + 5
            while control_privilege(ADDRESS, timeout_s=0.1) is None:
                if time.monotonic() > deadline:
                    raise TimeoutError("the fake camera does not answer within 5 s")
            yield process
        finally:
            process.kill()


def frames_land_in_our_memory() -> dict[str, object]:
    with fake_camera():
        flight = Flight()
        found = flight.head.bind()
        flight.thread.start()
        flight.wait_active()
        delays_ms = flight.expose(8)
        flight.head.close()
        flight.thread.join(3)
    pictures = flight.pictures
    return {
        "found": found,
        "statuses": [frame.status.value for frame in flight.frames],
        "slots": [frame.slot for frame in flight.frames],
        "ids": [frame.frame_id for frame in flight.frames],
        "size": [flight.frames[0].width_px, flight.frames[0].height_px],
        "settings": dict(flight.frames[0].settings),
        "delays_ms": delays_ms,
        "is_diagonal_ramp": [bool((p[1:, :-1] == p[:-1, 1:]).all()) for p in pictures],
        "next_is_shifted_by_one": [
            bool((b[:, :-1] == a[:, 1:]).all()) for a, b in itertools.pairwise(pictures)
        ],
        "behind_the_pixels_untouched": bool((flight.memory.slots[:, NBYTES:] == UNTOUCHED).all()),
        "states_at_opened": flight.states_at_opened,
        "state": flight.head.state.value,
        "statistics": dict(flight.head.statistics()),
        "thread_ended": not flight.thread.is_alive(),
    }


def a_killed_head_is_found_again() -> dict[str, object]:
    flight = Flight()
    with fake_camera() as camera:
        flight.thread.start()
        flight.wait_active()
        flight.expose(2)
        camera.kill()
        camera.wait(5)
        watch = Stopwatch()
        flight.wait_event("lost", 1, 60)
        lost_s = watch.own_s
    with fake_camera():
        watch = Stopwatch()
        flight.wait_event("opened", 2, 60)
        reopened_s = watch.own_s
        flight.wait_active()
        flight.expose(2)
        after = len(flight.frames)
        flight.head.close()
        flight.thread.join(3)
    return {
        "events": flight.names,
        "faults": [event.is_fault for _, event in flight.events],
        "lost_after_s": lost_s,
        "reopened_after_s": reopened_s,
        "frames": after,
        "opened": flight.head.statistics()["opened"],
    }


def a_quick_restart_is_noticed() -> dict[str, object]:
    flight = Flight()
    with fake_camera() as camera:
        flight.thread.start()
        flight.wait_active()
        flight.expose(1)
        watch = Stopwatch()
        camera.kill()
        camera.wait(5)
    with fake_camera():
        flight.wait_event("opened", 2, 60)
        back_s = watch.own_s
        flight.wait_active()
        flight.expose(2)
        flight.head.close()
        flight.thread.join(3)
    return {"events": flight.names, "back_after_s": back_s, "frames": len(flight.frames)}


HOLDER = """
import sys
from drivers.cameras.aravis.library import aravis
camera = aravis().Camera.new(sys.argv[1])
print(camera.get_device().is_controller(), flush=True)
sys.stdin.read()
"""


def a_dead_controllers_hold_is_waited_out() -> dict[str, object]:
    with (
        fake_camera(),
        subprocess.Popen(
            [sys.executable, "-c", HOLDER, ADDRESS], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as holder,
    ):
        assert holder.stdout is not None
        controls = holder.stdout.readline().strip().decode()
        impatient = Flight(control_wait_limit_s=1)
        try:
            impatient.head.bind()
            refused = ""
        except DeviceError as error:
            refused = str(error)
        flight = Flight()
        event_names: list[str] = []
        holder.kill()
        holder.wait(5)
        watch = Stopwatch()
        flight.head.bind(
            lambda record: (
                event_names.append(record.name) if isinstance(record, DeviceEvent) else None
            )
        )
        waited_s = watch.own_s
        flight.thread.start()
        flight.wait_active()
        flight.expose(2)
        flight.head.close()
        flight.thread.join(3)
    return {
        "controls": controls,
        "refused": refused,
        "reported": event_names,
        "waited_s": waited_s,
        "frames": len(flight.frames),
    }


def refused_settings_come_together() -> dict[str, object]:
    with fake_camera():
        refusals = []
        for more in (
            {"tdi_shifts": 12, "gain_db": 6, "exposure_time_us": 5e7, "pixel_format": "Mono12p"},
            {"serial": "T2"},
            {"trigger_source": "line", "trigger_line": "Line7"},
        ):
            try:
                Flight(**more).head.bind()
                refusals.append("")
            except DeviceError as error:
                refusals.append(str(error))
        small = Flight()
        small.memory.slot_nbytes = 1000
        try:
            small.head.bind()
            refusals.append("")
        except DeviceError as error:
            refusals.append(str(error))
        still_free = control_privilege(ADDRESS, timeout_s=0.5)
    try:
        Flight().head.bind()
        refusals.append("")
    except DeviceError as error:
        refusals.append(str(error))
    return {"refusals": refusals, "privilege_afterwards": still_free}


def lost_packets_make_incomplete_frames() -> dict[str, object]:
    with fake_camera("-r", "20"):
        flight = Flight()
        flight.thread.start()
        flight.wait_active()
        flight.expose(4)
        flight.head.close()
        flight.thread.join(3)
    return {
        "statuses": [frame.status.value for frame in flight.frames],
        "statistics": dict(flight.head.statistics()),
    }


def taken_slots_lose_frames_at_the_stream() -> dict[str, object]:
    with fake_camera():
        flight = Flight(recycle=False, slot_count=3)
        flight.thread.start()
        flight.wait_active()
        flight.expose(3)
        pause = threading.Event()
        for _ in range(2):
            flight.head.trigger()
            pause.wait(0.2)
        lost = flight.head.statistics()["underruns"]
        flight.recycle = True
        for frame in list(flight.frames):
            flight.head.recycle(frame.slot)
        try:
            flight.head.recycle(0)
            twice = ""
        except ValueError as error:
            twice = str(error)
        flight.expose(2)
        flight.head.close()
        flight.thread.join(3)
    return {
        "frames": len(flight.frames),
        "underruns": lost,
        "events": flight.names,
        "twice": twice,
    }


def closing_a_dead_head_takes_two_seconds_at_most() -> dict[str, object]:
    flight = Flight()
    with fake_camera() as camera:
        flight.thread.start()
        flight.wait_active()
        flight.expose(1)
        camera.kill()
        camera.wait(5)
        watch = Stopwatch()
        flight.head.close()
        closed_s = watch.own_s
        flight.thread.join(60)
        ended_s = watch.own_s
    return {"closed_s": closed_s, "ended_s": ended_s, "state": flight.head.state.value}


def a_head_that_waits_for_its_line_refuses_a_software_trigger() -> dict[str, object]:
    with fake_camera():
        flight = Flight(trigger_source="line", trigger_line="Line0")
        flight.thread.start()
        flight.wait_active()
        try:
            flight.head.trigger()
            refused = ""
        except DeviceError as error:
            refused = str(error)
        flight.head.close()
        flight.thread.join(3)
    return {"refused": refused, "frames": len(flight.frames)}


def packets_fit_the_network() -> dict[str, object]:
    """A network that carries 1500 bytes; only in a namespace of our own, where nobody minds."""
    from sim_hw.gige.gige_head import ExposureRequest, FrameSize, GigeHead, HeadIdentity
    from sim_hw.world.world_clock import FreeRunningClock

    set_mtu = 0x8922
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, set_mtu, struct.pack("16si12x", b"lo", 1500))
    picture = np.arange(SIZE * SIZE, dtype=np.uint16).reshape(SIZE, SIZE) & 0xFFF

    def expose(_request: ExposureRequest) -> np.ndarray[Any, np.dtype[np.uint16]]:
        return picture

    head = GigeHead(
        HeadIdentity(ADDRESS, "M-1"),
        FrameSize(SIZE, SIZE),
        expose,
        lambda _mono_ns: 30.0,
        FreeRunningClock(),
    )
    head.start()
    flight = Flight(frame_retention_ms=2000.0)
    flight.thread.start()
    flight.wait_active()
    flight.expose(2)
    flight.head.close()
    flight.thread.join(3)
    head.close()
    return {
        "packet_sizes": [int(f.settings["GevSCPSPacketSize"]) for f in flight.frames],
        "statuses": [frame.status.value for frame in flight.frames],
        "equal": [bool((p == picture).all()) for p in flight.pictures],
    }


def light_that_changes_is_followed() -> dict[str, object]:
    """The emulated head in a light that falls to a tenth and comes back; the law steers it."""
    from processing.radiometry.exposure_control import (
        ExposureLimits,
        ExposureSettings,
        next_settings,
        sampled_histogram,
    )
    from sim_hw.gige.gige_head import ExposureRequest, FrameSize, GigeHead, HeadIdentity
    from sim_hw.world.world_clock import FreeRunningClock

    random = np.random.default_rng(4)
    ground = np.minimum(random.lognormal(-1.4, 0.5, (SIZE, SIZE)), 2.0)
    requests: list[ExposureRequest] = []
    sun = [*(0.88**k for k in range(18)), *(0.88 ** (17 - k) for k in range(18))]

    def expose(request: ExposureRequest) -> np.ndarray[Any, np.dtype[np.uint16]]:
        requests.append(request)
        light = request.exposure_time_us / 4000.0 * 10 ** (request.gain_db / 20)
        dn = 200.0 + 3300.0 * ground * sun[min(len(requests), len(sun)) - 1] * light
        return np.minimum(dn, 4095.0).astype(np.uint16)

    head = GigeHead(
        HeadIdentity(ADDRESS, "M-1"),
        FrameSize(SIZE, SIZE),
        expose,
        lambda _mono_ns: 30.0,
        FreeRunningClock(),
    )
    head.start()
    limits = ExposureLimits(*(100.0, 30_000.0, 12.0, 4, 256.0), smear_px=0.5, black=200.0 / 4095.0)
    now = ExposureSettings(EXPOSURE_US)
    flight = Flight()
    flight.thread.start()
    flight.wait_active()
    for _ in sun:
        flight.expose(1)
        now = next_settings(sampled_histogram(flight.pictures[-1], 12), now, limits)
        flight.head.adjust(now.exposure_time_us, now.gain_db, now.tdi_shifts)
    try:
        flight.head.adjust(1e12, 0.0, 0)
        refused = ""
    except DeviceError as error:
        refused = str(error)
    flight.head.close()
    flight.thread.join(3)
    head.close()
    return {
        "asked": [[r.exposure_time_us, r.gain_db, r.tdi_shifts] for r in requests],
        "reported": [
            [f.exposure_time_us, f.settings["Gain"], f.settings["TdiShifts"]] for f in flight.frames
        ],
        "bright": [float(np.percentile(p, 99)) / 4095.0 for p in flight.pictures],
        "radiance": [
            float((p[p < 4095] - 200.0).mean())
            / (f.exposure_time_us or 1.0)
            / 10 ** (float(f.settings["Gain"]) / 20)
            for p, f in zip(flight.pictures, flight.frames, strict=True)
        ],
        "sun": sun,
        "refused": refused,
    }


def raise_loopback() -> None:
    """Bring up `lo` of a fresh namespace; without the right to, it is up already."""
    get_flags, set_flags, up = 0x8913, 0x8914, 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        request = struct.pack("16sH14x", b"lo", 0)
        flags = struct.unpack_from("16sH", fcntl.ioctl(any_socket, get_flags, request))[1]
        if not flags & up:
            fcntl.ioctl(any_socket, set_flags, struct.pack("16sH14x", b"lo", flags | up))


if __name__ == "__main__":
    raise_loopback()
    print(json.dumps(globals()[sys.argv[1]]()))
