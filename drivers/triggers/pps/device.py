"""A pulse per second: edges on the host's monotonic clock, independent of wall clock steps.

The second of an edge, and GPS time, are determined elsewhere.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, Final, Protocol

from drivers.base.device import DeviceDriver
from drivers.base.settings import Setting
from drivers.contract import DeviceError, LifeCycle, PpsEdge, Sink
from drivers.timescales.clock import Clock
from drivers.triggers.pps.binding import CAN_WAIT, CAPTURE_ASSERT, CAPTURE_CLEAR, Edges, KernelPps
from drivers.triggers.pps.emulated import SCHEME, EmulatedPps

WAIT_TIMEOUT_S: Final = 0.5
"""Longest wait in the kernel before the driver checks whether it is closed."""
OFFSET_ATTEMPTS: Final = 5
MAX_SLEW_RATE: Final = 1e-3
"""Twice the fastest slew of the wall clock by a time daemon."""
STEP_NS: Final = 50_000
MAX_EDGE_AGE_NS: Final = 2_000_000_000


class PpsBackend(Protocol):
    """A source of edges."""

    def capabilities(self) -> int:
        """What the source can do.

        Returns:
            CAPTURE_* and CAN_* bits of `drivers.triggers.pps.binding`.
        """

    def mode(self) -> int:
        """The edges that are captured at present.

        Returns:
            CAPTURE_* bits.
        """

    def set_mode(self, mode: int) -> None:
        """Capture these edges.

        Args:
            mode: CAPTURE_* bits.

        Raises:
            OSError: not permitted or not possible.
        """

    def fetch(self, timeout_s: float) -> Edges | None:
        """Wait for the next edge.

        Args:
            timeout_s: longest wait, s.

        Returns:
            The last edges; None if none is captured in time.

        Raises:
            OSError: the source is lost.
        """

    def latest(self) -> Edges | None:
        """The last edges, without waiting.

        Returns:
            The last edges; None if the source does not remember them.

        Raises:
            OSError: the source is lost.
        """

    def is_there(self) -> bool:
        """Whether the source still exists.

        Returns:
            False if it was removed or replaced.
        """

    def close(self) -> None:
        """Release the source; may be called twice."""


def open_source(device: str) -> PpsBackend:
    """Open a source by its name.

    Args:
        device: path of a kernel device, or tcp://host:port of an emulated one.

    Returns:
        The open source.

    Raises:
        OSError: it does not exist or may not be opened.
    """
    return EmulatedPps(device) if device.startswith(SCHEME) else KernelPps(device)


def wall_clock() -> tuple[int, int]:
    """The host's wall clock relative to its monotonic clock, from the shortest of several readings.

    Returns:
        CLOCK_MONOTONIC, ns, and CLOCK_REALTIME minus CLOCK_MONOTONIC at about that instant, ns.
    """
    best: tuple[int, int, int] | None = None
    for _ in range(OFFSET_ATTEMPTS):
        before = time.monotonic_ns()
        real = time.time_ns()
        after = time.monotonic_ns()
        if best is None or after - before < best[0]:
            middle = (before + after) // 2
            best = (after - before, middle, real - middle)
    assert best is not None
    return best[1], best[2]


class PpsDevice(DeviceDriver):
    """Edges of one PPS source of the kernel.

    The kernel stamps edges with the wall clock. The driver converts them to the monotonic clock
    with the difference of both clocks just afterwards. If that difference has jumped since the
    previous edge, the wall clock was set in between; the edge is dropped and counted.

    Source: include/uapi/linux/pps.h; RFC 2783.
    """

    kind: ClassVar = "pps"
    counted = (
        "edges",
        "edges_missed",
        "edges_repeated",
        "wall_clock_steps",
        "opened",
        "silences",
    )
    delivery_counter = "edges"

    device = Setting(
        "", required=True, help="such as /dev/pps0; tcp://host:port is an emulated one"
    )
    edge = Setting("assert", choices=("assert", "clear"), help="which edge begins the second")
    latency_ns = Setting(
        0,
        minimum=-1_000_000,
        maximum=1_000_000,
        help="known latency from the edge to the kernel's time stamp",
    )
    sigma_ns = Setting(
        5_000,
        minimum=10,
        maximum=10_000_000,
        help="standard deviation of that latency, with its jitter",
    )
    silence_s = Setting(
        2.5,
        minimum=1.1,
        maximum=60,
        help="time without an edge after which the source is reported silent",
    )

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        clock: Clock | None = None,
        source_opener: Callable[[str], PpsBackend] = open_source,
        wall: Callable[[], tuple[int, int]] = wall_clock,
    ) -> None:
        super().__init__(name, settings, clock=clock)
        self._opener, self._wall = source_opener, wall
        self._source: PpsBackend | None = None
        self._last_sequence: int | None = None
        self._last_wall: tuple[int, int] | None = None

    def bind(self) -> Mapping[str, str]:
        """Open the source and wait for an edge. See `drivers.contract.Device`.

        Returns:
            device, edge, count and, where the kernel states it, source.

        Raises:
            DeviceError: the source cannot be opened, cannot capture the edge, or sends none within
                `silence_s`.
        """
        source = self._source = self._source or self._open()
        deadline_ns = self.clock.mono_ns() + round(self.silence_s * 1e9)
        while self.clock.mono_ns() < deadline_ns and not self._closing.is_set():
            try:
                edges = source.fetch(WAIT_TIMEOUT_S)
            except OSError as error:
                self._release_device()
                raise self._source_lost(error) from error
            if edges is not None and self._of(edges)[1]:
                self._state = LifeCycle.BOUND
                found = {"device": self.device, "edge": self.edge, "count": str(self._of(edges)[0])}
                label = Path("/sys/class/pps", Path(self.device).name, "name")
                if label.is_file():
                    found["source"] = label.read_text(encoding="utf-8").strip()
                return found
        self._release_device()
        raise DeviceError(
            f"{self.name}: no {self.edge} edge came at {self.device} in {self.silence_s:g} s: "
            "check the PPS cable, that the receiver has a fix and sends PPS, and the polarity"
        )

    def edge_of(self, edges: Edges) -> PpsEdge | None:
        """An edge on the monotonic clock.

        Args:
            edges: last edges of the source, just fetched.

        Returns:
            The configured edge with its latency subtracted; None if it is not new, is older than
            MAX_EDGE_AGE_NS, or the wall clock was set since the previous one.
        """
        mono_ns, offset_ns = wall = self._wall()
        last, self._last_wall = self._last_wall, wall
        if last is not None:
            slewed_ns = STEP_NS + round((mono_ns - last[0]) * MAX_SLEW_RATE)
            if abs(offset_ns - last[1]) > slewed_ns:
                self.counters["wall_clock_steps"] += 1
                self._last_sequence = self._of(edges)[0]
                return None
        sequence, real_ns = self._of(edges)
        previous, self._last_sequence = self._last_sequence, sequence
        if not real_ns or sequence == previous:
            self.counters["edges_repeated"] += 1
            return None
        if previous is not None and 1 < (jump := (sequence - previous) % 2**32) < 2**31:
            self.counters["edges_missed"] += jump - 1
        edge_ns = real_ns - offset_ns
        if not 0 <= mono_ns - edge_ns + STEP_NS < MAX_EDGE_AGE_NS:
            self.counters["edges_repeated"] += 1
            return None
        self.counters["edges"] += 1
        return PpsEdge(self.name, sequence, edge_ns - self.latency_ns, self.sigma_ns)

    def _open_device(self) -> None:
        self._source = self._source or self._open()

    def _emit_opened(self) -> None:
        self.emitter.emit("opened", f"The pulse per second {self.name} is open.")

    def _serve(self, sink: Sink) -> None:
        self._begin_delivery()
        try:
            self._listen(sink)
        except OSError as error:
            self._emit_lost(f"{self._source_lost(error)}. Retrying automatically.")

    def _listen(self, sink: Sink) -> None:
        source = self._source
        assert source is not None
        silence_ns = round(self.silence_s * 1e9)
        last_edge_ns, is_silent = self.clock.mono_ns(), False
        self._last_wall = self._wall()
        if self._last_sequence is None and (before := source.latest()) is not None:
            self._last_sequence = self._of(before)[0]
        while not self._closing.is_set():
            edges = source.fetch(WAIT_TIMEOUT_S) or self._edge_between_waits(source)
            edge = None if edges is None else self.edge_of(edges)
            if edge is not None:
                sink(edge)
                last_edge_ns = self.clock.mono_ns()
                if is_silent:
                    is_silent = False
                    self.emitter.emit("recovered", f"The pulse per second {self.name} is back.")
            elif not is_silent and self.clock.mono_ns() - last_edge_ns >= silence_ns:
                is_silent = True
                self.counters["silences"] += 1
                self.emitter.emit(
                    "silent",
                    f"No edge of the pulse per second {self.name} for {self.silence_s:g} s; check "
                    "the PPS cable and the receiver's fix. The clock coasts.",
                    fault=True,
                )
            if is_silent and not source.is_there():
                raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    def _edge_between_waits(self, source: PpsBackend) -> Edges | None:
        """An edge that was captured between two waits; None if there is none."""
        edges = source.latest()
        return None if edges is None or self._of(edges)[0] == self._last_sequence else edges

    def _of(self, edges: Edges) -> tuple[int, int]:
        if self.edge == "assert":
            return edges.assert_sequence, edges.assert_ns
        return edges.clear_sequence, edges.clear_ns

    def _open(self) -> PpsBackend:
        try:
            source = self._opener(self.device)
        except OSError as error:
            raise self._source_lost(error) from error
        wanted = CAPTURE_ASSERT if self.edge == "assert" else CAPTURE_CLEAR
        try:
            can = source.capabilities()
            if not can & wanted or not can & CAN_WAIT:
                other = "clear" if self.edge == "assert" else "assert"
                raise DeviceError(
                    f"{self.name}: {self.device} cannot capture {self.edge} edges; set edge = "
                    f'"{other}", or invert the polarity of the receiver\'s PPS'
                )
            mode = source.mode()
            if not mode & wanted:
                source.set_mode(mode | wanted)
        except (OSError, DeviceError) as error:
            source.close()
            raise error if isinstance(error, DeviceError) else self._source_lost(error) from error
        self.counters["opened"] += 1
        self._last_sequence = None
        return source

    def _source_lost(self, error: OSError) -> DeviceError:
        why = error.strerror or str(error)
        if isinstance(error, FileNotFoundError):
            why = "no such device; load pps-ldisc or pps-gpio and check its name in /sys/class/pps"
        elif isinstance(error, PermissionError):
            why = "permission denied; install the udev rules, which give it to the service's group"
        return DeviceError(f"{self.name}: pulse per second at {self.device}: {why}")

    def _release_device(self) -> None:
        source, self._source = self._source, None
        if source is not None:
            source.close()
        if self._state is not LifeCycle.CREATED:
            self._state = LifeCycle.INACTIVE
