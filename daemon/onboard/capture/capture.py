"""The capture process: every device of the rig, each in its own thread.

The only process that imports GigE Vision and friends. Records go to the service as they come;
frames stay in shared memory and only their slot numbers are sent.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from daemon.onboard.capture.frame_ring import FrameRing
from daemon.onboard.service.messages import (
    ApplyExposureSettings,
    BindFailed,
    Bound,
    DeviceSpec,
    Fire,
    Fired,
    Ping,
    Pong,
    Recycle,
    Stop,
)
from daemon.onboard.service.processes import ServiceConnection
from daemon.onboard.timing.timesync import TimesyncRequester, supports_timesync
from drivers.base import registry
from drivers.contract import (
    Device,
    DeviceError,
    DeviceEvent,
    FrameMemory,
    Head,
    Record,
    Trigger,
)

CLOSE_TIMEOUT_S = 3.0


def main(
    link: ServiceConnection, specs: tuple[DeviceSpec, ...], rings: tuple[FrameRing, ...]
) -> None:
    """Open the devices and deliver their records until a stop message arrives."""
    _Capture(link, specs, {ring.head: ring for ring in rings}).run()


class _Capture:
    def __init__(
        self, link: ServiceConnection, specs: tuple[DeviceSpec, ...], rings: Mapping[str, FrameRing]
    ) -> None:
        self.link = link
        self.devices: dict[str, tuple[DeviceSpec, Device]] = {}
        self.heads: dict[str, Head] = {}
        self.heads_of_output: dict[str, list[Head]] = {}
        self.requests: queue.SimpleQueue[Fire | ApplyExposureSettings | None] = queue.SimpleQueue()
        trigger_spec: DeviceSpec | None = None
        for spec in specs:
            if spec.kind == "trigger":
                trigger_spec = spec
                continue
            device = open_device(spec, memory=rings.get(spec.name))
            self.devices[spec.name] = (spec, device)
            if spec.kind == "head":
                self.heads[spec.name] = device
                self.heads_of_output.setdefault(spec.output, []).append(device)
        self.trigger_spec = trigger_spec
        self.trigger: Trigger | None = None
        self.requesters = [
            TimesyncRequester(device, self._sink)
            for _, device in self.devices.values()
            if supports_timesync(device)
        ]

    def run(self) -> None:
        threads = [
            threading.Thread(target=self._deliver, args=pair, name=pair[0].name, daemon=True)
            for pair in self.devices.values()
        ]
        threads.append(threading.Thread(target=self._run_trigger, name="trigger", daemon=True))
        threads += [
            threading.Thread(target=requester.run, name="timesync", daemon=True)
            for requester in self.requesters
        ]
        for thread in threads:
            thread.start()
        while not isinstance(request := self.link.receive(timeout_s=1.0), Stop):
            if isinstance(request, Recycle):
                for head, slot in request.slots.items():
                    self.heads[head].recycle(slot)
            elif isinstance(request, Fire | ApplyExposureSettings):
                self.requests.put(request)
            elif isinstance(request, Ping):
                self.link.send(Pong(self._statistics()))
        self.requests.put(None)
        for requester in self.requesters:
            requester.stop()
        closers = [
            threading.Thread(target=device.close, daemon=True)
            for _, device in self.devices.values()
        ]
        for closer in closers:
            closer.start()
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        for thread in (*closers, *threads):
            thread.join(max(0.0, deadline - time.monotonic()))

    def _statistics(self) -> dict[str, dict[str, int]]:
        """The counters of every device, by its name."""
        counted = {name: dict(device.statistics()) for name, (_, device) in self.devices.items()}
        if self.trigger is not None:
            counted[self.trigger.name] = dict(self.trigger.statistics())
        return counted

    def _deliver(self, spec: DeviceSpec, device: Device) -> None:
        try:
            # `bind` waits while a dead controller still holds the head, and emits an event.
            found = self.heads[spec.name].bind(self._sink) if spec.kind == "head" else device.bind()
            self.link.send(Bound(spec.kind, spec.name, dict(found)))
        except DeviceError as error:
            self.link.send(BindFailed(spec.kind, spec.name, str(error)))
        device.run(self._sink)

    def _sink(self, record: Record) -> None:
        self.link.send(record)

    def _run_trigger(self) -> None:
        """Run the trigger in a separate thread: a slow unit delays no frame."""
        if self.trigger_spec is None:
            return
        spec = self.trigger_spec
        self.trigger = trigger = open_device(spec, heads=self.heads_of_output)
        programmed: Mapping[str, int] = {}
        try:
            self.link.send(Bound("trigger", spec.name, dict(trigger.bind())))
        except DeviceError as error:
            self.link.send(BindFailed("trigger", spec.name, str(error)))
        while (request := self.requests.get()) is not None:
            if isinstance(request, ApplyExposureSettings):
                self._adjust(request)
                continue
            try:
                if request.delays_ns != programmed:
                    trigger.program(request.delays_ns)
                    programmed = request.delays_ns
                pulse = trigger.fire(request.sequence)
            except DeviceError as error:
                programmed = {}
                self.link.send(Fired(request.sequence, None, str(error)))
                event = DeviceEvent(spec.name, "not-fired", True, str(error), time.monotonic_ns())
                self.link.send(event)
            else:
                self.link.send(Fired(request.sequence, pulse, ""))
        trigger.close()

    def _adjust(self, request: ApplyExposureSettings) -> None:
        """In the thread of the trigger, so that no pulse comes in between."""
        for head, setting in request.settings.items():
            try:
                self.heads[head].adjust(
                    setting.exposure_time_us, setting.gain_db, setting.tdi_shifts
                )
            except DeviceError as error:
                event = DeviceEvent(head, "not-adjusted", False, str(error), time.monotonic_ns())
                self.link.send(event)


def open_device(
    spec: DeviceSpec,
    *,
    memory: FrameMemory | None = None,
    heads: Mapping[str, Sequence[Head]] | None = None,
) -> Any:
    """A device of `spec`, created and not yet touched.

    A head needs its `memory`, a trigger that fires them itself the `heads` of every output.
    """
    driver: Any = registry.driver_for(spec.kind, spec.driver)
    if spec.kind == "head":
        return driver(spec.name, spec.settings, memory=memory)
    if spec.kind == "trigger" and getattr(driver, "fires_heads", False):
        return driver(spec.name, spec.settings, heads=heads)
    return driver(spec.name, spec.settings)
