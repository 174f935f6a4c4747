"""The capture process: every device of the rig, each in its own thread.

The only process that imports GigE Vision and friends. Records go to the service as they come;
frames lie in shared memory and only their slot numbers travel.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from daemon.onboard.capture.memory import FrameRing
from daemon.onboard.service.messages import (
    Adjust,
    Bound,
    DeviceSpec,
    Fire,
    Fired,
    NotBound,
    Ping,
    Pong,
    Recycle,
    Stop,
)
from daemon.onboard.service.processes import Link
from daemon.onboard.timing.timesync import TimesyncAsker, can_be_asked
from drivers.base import registry
from drivers.contract import (
    Device,
    DeviceError,
    DeviceEvent,
    FrameMemory,
    Head,
    Record,
)

CLOSE_TIMEOUT_S = 3.0


def main(link: Link, specs: tuple[DeviceSpec, ...], rings: tuple[FrameRing, ...]) -> None:
    """Open the devices, deliver until told to stop."""
    _Capture(link, specs, {ring.head: ring for ring in rings}).run()


class _Capture:
    def __init__(
        self, link: Link, specs: tuple[DeviceSpec, ...], rings: Mapping[str, FrameRing]
    ) -> None:
        self.link = link
        self.devices: dict[str, tuple[DeviceSpec, Device]] = {}
        self.heads: dict[str, Head] = {}
        self.heads_of_output: dict[str, list[Head]] = {}
        self.orders: queue.SimpleQueue[Fire | Adjust | None] = queue.SimpleQueue()
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
        self.askers = [
            TimesyncAsker(device, self._sink)
            for _, device in self.devices.values()
            if can_be_asked(device)
        ]

    def run(self) -> None:
        threads = [
            threading.Thread(target=self._deliver, args=pair, name=pair[0].name, daemon=True)
            for pair in self.devices.values()
        ]
        threads.append(threading.Thread(target=self._fire_orders, name="trigger", daemon=True))
        threads += [
            threading.Thread(target=asker.run, name="timesync", daemon=True)
            for asker in self.askers
        ]
        for thread in threads:
            thread.start()
        while not isinstance(order := self.link.receive(timeout_s=1.0), Stop):
            if isinstance(order, Recycle):
                for head, slot in order.slots.items():
                    self.heads[head].recycle(slot)
            elif isinstance(order, Fire | Adjust):
                self.orders.put(order)
            elif isinstance(order, Ping):
                counted = {name: dict(d.statistics()) for name, (_, d) in self.devices.items()}
                self.link.send(Pong(counted))
        self.orders.put(None)
        for asker in self.askers:
            asker.stop()
        closers = [
            threading.Thread(target=device.close, daemon=True)
            for _, device in self.devices.values()
        ]
        for closer in closers:
            closer.start()
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        for thread in (*closers, *threads):
            thread.join(max(0.0, deadline - time.monotonic()))

    def _deliver(self, spec: DeviceSpec, device: Device) -> None:
        try:
            # A head that a dead controller still holds is waited out here, and says so.
            found = self.heads[spec.name].bind(self._sink) if spec.kind == "head" else device.bind()
            self.link.send(Bound(spec.kind, spec.name, dict(found)))
        except DeviceError as error:
            self.link.send(NotBound(spec.kind, spec.name, str(error)))
        device.run(self._sink)

    def _sink(self, record: Record) -> None:
        self.link.send(record)

    def _fire_orders(self) -> None:
        """The trigger in a thread of its own: a slow unit holds up no frame."""
        if self.trigger_spec is None:
            return
        spec = self.trigger_spec
        trigger = open_device(spec, heads=self.heads_of_output)
        programmed: Mapping[str, int] = {}
        try:
            self.link.send(Bound("trigger", spec.name, dict(trigger.bind())))
        except DeviceError as error:
            self.link.send(NotBound("trigger", spec.name, str(error)))
        while (order := self.orders.get()) is not None:
            if isinstance(order, Adjust):
                self._adjust(order)
                continue
            try:
                if order.delays_ns != programmed:
                    trigger.program(order.delays_ns)
                    programmed = order.delays_ns
                pulse = trigger.fire(order.sequence)
            except DeviceError as error:
                programmed = {}
                self.link.send(Fired(order.sequence, None, str(error)))
                event = DeviceEvent(spec.name, "not-fired", True, str(error), time.monotonic_ns())
                self.link.send(event)
            else:
                self.link.send(Fired(order.sequence, pulse, ""))
        trigger.close()

    def _adjust(self, order: Adjust) -> None:
        """In the thread of the trigger, so that no pulse comes in between."""
        for head, wanted in order.settings.items():
            try:
                self.heads[head].adjust(wanted.exposure_time_us, wanted.gain_db, wanted.tdi_shifts)
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
