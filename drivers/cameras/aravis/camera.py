"""One opened GenICam head: its settings, clock and trigger.

Frames are in `drivers.cameras.aravis.stream`; opening, loss and reconnection are in
`drivers.cameras.aravis.aravis_head`.
"""

from __future__ import annotations

import contextlib
import gc
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from drivers.cameras.aravis.camera_access import (
    ControlDeniedError,
    endless_features,
    local_interface,
    open_camera,
)
from drivers.cameras.aravis.chunk_configuration import switch_on_chunks
from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.formats import packing_of, packing_problem
from drivers.cameras.aravis.gvcp import GVCP_PORT, is_ip_address
from drivers.cameras.aravis.head_configuration import HeadConfiguration
from drivers.cameras.aravis.head_thermometer import TEMPERATURES, HeadThermometer
from drivers.cameras.aravis.library import aravis, aravis_error, message_of
from drivers.cameras.aravis.missing_features import missing_sentence
from drivers.cameras.aravis.packet_filter import ControlSocketFilter, SocketCapture
from drivers.cameras.aravis.packet_pacing import link_rate_mbps, write_pacing
from drivers.cameras.aravis.presets import FeatureValue
from drivers.cameras.aravis.ptp import PtpFeatures
from drivers.cameras.aravis.settings import AravisSettings
from drivers.cameras.pixels import Packing, packed_nbytes
from drivers.contract import DeviceError

LATCH_ATTEMPTS: Final = 3
NS_PER_S: Final = 1_000_000_000
SETTINGS_HISTORY_LENGTH: Final = 4
EXPOSURE_TIME_TOLERANCE: Final = 0.01
"""Relative tolerance between a frame's exposure time and the configured one; heads round it."""
CLOCKS: Final = (
    ("TimestampLatch", "TimestampLatchValue", True),
    ("TimestampLatch", "Timestamp", True),
    ("GevTimestampControlLatch", "GevTimestampValue", False),
)
ENDLESS_NAMES_MAX: Final = 4
PACKET_SIZE: Final = "GevSCPSPacketSize"


@dataclass(frozen=True)
class ClockLatch:
    """A reading of the head's clock and its host time."""

    device_clock_ns: int
    mono_ns: int
    sigma_ns: int


@dataclass(frozen=True)
class FrameGeometry:
    """The configured size and format of a frame."""

    width_px: int
    height_px: int
    pixel_format: str
    pixel_format_code: int
    packing: Packing
    payload_nbytes: int


class AravisCamera:
    """An opened and configured head, with control access.

    Not thread-safe: the caller holds a lock during every call, and
    `drivers.cameras.aravis.library.OPENING` during construction.

    Raises:
        ControlDeniedError: another program has control.
        DeviceError: it does not answer or refuses settings; all refusals in one message.
    """

    def __init__(self, head: str, settings: AravisSettings) -> None:
        self._who = f"{head} at {settings.address}"
        self.chunk_parser: Any = None
        self.chunks: list[str] = []
        self.chunks_missing = ""
        self._pacing: Mapping[str, FeatureValue] = {}
        self._control: ControlSocketFilter | None = None
        try:
            self._open_and_configure(settings)
        except (DeviceError, aravis_error()):
            self.release()
            raise

    def _open_and_configure(self, settings: AravisSettings) -> None:
        address = settings.address
        self._camera: Any = None
        if not is_ip_address(address):
            self._camera = open_camera(self._who, "", address)
            if not self._camera.is_gv_device():
                self._configure_all(settings)
                return
            # Open it again by its address, which the socket filters need.
            address = self.ip_address
            self._camera = None
            gc.collect()
        interface = local_interface(self._who, address)
        with SocketCapture(interface, address) as sockets:
            self._camera = open_camera(self._who, interface, address)
            self._control = ControlSocketFilter(sockets.take(), address, GVCP_PORT)
            self._configure_all(settings)

    def _configure_all(self, settings: AravisSettings) -> None:
        if self._camera.is_gv_device() and not self._camera.get_device().is_controller():
            raise ControlDeniedError(
                f"{self._who}: another program controls the head; end that program"
            )
        device = self._camera.get_device()
        self._features = Features(device, endless_features(self._who, device))
        self._configuration = HeadConfiguration(self._features, settings)
        self.identity = self._identity(settings)
        refusals = self._configure(settings)
        if refusals and self._features.endless:
            names = ", ".join(sorted(self._features.endless)[:ENDLESS_NAMES_MAX])
            refusals.append(f"its description refers to itself ({names}); update its firmware")
        if refusals:
            raise DeviceError("\n".join(f"{self._who}: {refusal}" for refusal in refusals))
        self.ptp = PtpFeatures(self._features) if settings.ptp else None
        if self.ptp is not None and (refusal := self.ptp.enable()):
            raise DeviceError(f"{self._who}: {refusal}")
        self._tick_hz = self._read_tick_frequency()
        self._latch_features = self._find_latch()
        self.thermometer = HeadThermometer(self._features)
        if settings.temperature_probe and self.thermometer.feature is None:
            raise DeviceError(
                f"{self._who}: the head has no thermometer ({' or '.join(TEMPERATURES)}) for "
                f"temperature_probe = {settings.temperature_probe!r}; leave that setting out"
            )
        self.link_mbps = link_rate_mbps(self._features)
        self.exposure_time_us = self._configuration.exposure_time_us()
        self.frame_settings = self._frame_settings()
        self._earlier: deque[Mapping[str, float | int | str]] = deque(
            maxlen=SETTINGS_HISTORY_LENGTH
        )

    @property
    def raw(self) -> Any:
        """The Aravis camera, for the stream."""
        return self._camera

    @property
    def has_lost_control(self) -> bool:
        """Whether Aravis' heartbeat has found that the head no longer accepts control."""
        # Quirk: while the signal "control-lost" is emitted, the heartbeat's thread holds a
        # reference to the device. If the driver releases the device in that time, the thread joins
        # itself and GLib aborts. The state is polled instead.
        # Upstream: AravisProject/aravis#50 for the stream's thread; for the heartbeat's, no report
        # known (2026-11-23).
        camera = self._camera
        return bool(camera.is_gv_device() and not camera.get_device().is_controller())

    @property
    def held(self) -> Mapping[str, float | int | str]:
        """Every feature the driver wrote or switched off, with the value the head holds.

        Those of a frame as well: format, size, exposure time, gain and packet size. A truth value
        is 0 or 1.
        """
        written = {**self._configuration.written, **self._pacing}
        numbers = {k: int(v) if isinstance(v, bool) else v for k, v in written.items()}
        return {**numbers, **self.frame_settings}

    def start(self) -> None:
        """Start acquisition; raises the error of Aravis."""
        self._configuration.lock(True)
        self._camera.start_acquisition()

    def stop(self) -> None:
        """Stop acquisition; errors of a lost head are ignored."""
        with contextlib.suppress(aravis_error()):
            self._camera.stop_acquisition()
            self._configuration.lock(False)

    def release(self) -> None:
        """Release the head: dropping the last reference releases control."""
        self._camera = self.chunk_parser = None
        if self._control is not None:
            self._control.close()
            self._control = None

    @property
    def ip_address(self) -> str:
        """Address of a GigE Vision head, also if it was opened by its name."""
        return str(self._camera.get_device().get_device_address().get_address().to_string())

    @property
    def stream_source_port(self) -> int:
        """The source port of the stream in the head's register; 0 if it has none."""
        try:
            return int(self._camera.get_device().get_integer_feature_value("ArvGevSCSP")) & 0xFFFF
        except aravis_error():
            return 0

    def fire_test_packet(self) -> None:
        """Make the head send a test packet to the stream's port, if it can."""
        # Quirk: some heads send no test packet, among them Aravis' fake camera.
        # Upstream: AravisProject/aravis#278, AravisProject/aravis#1047.
        with contextlib.suppress(aravis_error()):
            self._camera.get_device().execute_command("ArvGevSCPSFireTestPacket")

    def other_senders(self) -> int:
        """Dropped datagrams of other senders at the control socket.

        Returns:
            Their number since the head was opened.
        """
        return 0 if self._control is None else self._control.dropped_datagrams()

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Write exposure settings while the head runs; features that it does not have are skipped.

        Args:
            exposure_time_us: exposure time, us.
            gain_db: gain, dB.
            tdi_shifts: number of TDI shifts.

        Raises:
            DeviceError: it refuses one.
        """
        try:
            self._configuration.adjust(exposure_time_us, gain_db, tdi_shifts)
            self._earlier.append(self.frame_settings)
            self.exposure_time_us = self._configuration.exposure_time_us()
            self.frame_settings = self._frame_settings()
        except FeatureError as error:
            raise DeviceError(
                f"{self._who}: {exposure_time_us:g} us, {gain_db:g} dB, {tdi_shifts} TDI shifts "
                f"are refused ({error}); choose settings within the head's bounds"
            ) from None

    def settings_of(self, exposure_us: float | None) -> Mapping[str, float | int | str]:
        """The settings of a frame, which may be from before `adjust`.

        Args:
            exposure_us: exposure time of the frame, us; None if it is unknown.

        Returns:
            The latest settings whose exposure time is within EXPOSURE_TIME_TOLERANCE of it; the
            present ones if there are none.
        """
        for settings in (self.frame_settings, *reversed(self._earlier)):
            time_us = float(settings["ExposureTime"])
            if (
                exposure_us is None
                or abs(time_us - exposure_us) <= EXPOSURE_TIME_TOLERANCE * time_us
            ):
                return settings
        return self.frame_settings

    def reported_gain(self, gain: float) -> Mapping[str, float | int | str]:
        """A gain in the chunk data of a frame, as frames record it.

        Args:
            gain: in the unit of the head's gain.

        Returns:
            The gain and its unit.
        """
        return self._configuration.gain.reported(gain)

    def software_trigger(self) -> None:
        """Fire the software trigger; raises the error of Aravis."""
        self._camera.software_trigger()

    def latch(self) -> ClockLatch | None:
        """Read the head's clock; raises the error of Aravis.

        Returns:
            The attempt with the shortest round trip; None if the head has no latch.
        """
        if self._latch_features is None:
            return None
        command, value, is_ns = self._latch_features
        best: ClockLatch | None = None
        for _ in range(LATCH_ATTEMPTS):
            before_ns = time.monotonic_ns()
            self._camera.execute_command(command)
            after_ns = time.monotonic_ns()
            ticks = self._camera.get_integer(value)
            sigma_ns = (after_ns - before_ns + 1) // 2
            if best is None or sigma_ns < best.sigma_ns:
                clock_ns = ticks if is_ns else self.ns_from_ticks(ticks)
                best = ClockLatch(clock_ns, before_ns + sigma_ns, sigma_ns)
        return best

    def check_alive(self) -> None:
        """Read a feature that is not cached; raises the error of Aravis."""
        name = self._configuration.exposure_feature
        device = self._camera.get_device()
        if self._features.kind(name) == "integer":
            device.get_integer_feature_value(name)
        else:
            device.get_float_feature_value(name)

    def ns_from_ticks(self, ticks: int) -> int:
        """A device clock in ns; exact also for a tick frequency that is no power of ten.

        Args:
            ticks: count of the clock.

        Returns:
            Nanoseconds, rounded down.
        """
        return ticks * NS_PER_S // self._tick_hz

    # Reading and writing features

    def _identity(self, settings: AravisSettings) -> dict[str, str]:
        camera, failed = self._camera, aravis_error()
        identity = {"address": settings.address}
        identity_features: Mapping[str, Callable[[], object]] = {
            "vendor": camera.get_vendor_name,
            "model": camera.get_model_name,
            "serial": camera.get_device_serial_number,
            "version": lambda: camera.get_string("DeviceVersion"),
        }
        for key, ask in identity_features.items():
            try:
                identity[key] = str(ask() or "")
            except (failed, UnicodeDecodeError):
                # Quirk: PyGObject raises UnicodeDecodeError for a text of the head that is not
                # UTF-8. The text is left empty. Upstream: no report known (2026-11-23).
                identity[key] = ""
        if settings.serial and identity["serial"] != settings.serial:
            raise DeviceError(
                f"{self._who}: serial number is {identity['serial']!r} where {settings.serial!r} "
                "is configured; another head is connected here, or serial is wrong"
            )
        return identity

    def _configure(self, settings: AravisSettings) -> list[str]:
        """Write every setting; returns one sentence per refusal."""
        configuration = self._configuration
        configuration.write()
        if self._camera.is_gv_device() and self._features.kind("PayloadSize") is None:
            configuration.missing.append("no feature PayloadSize")
        if configuration.missing:
            return [missing_sentence(self._features, configuration.missing)]
        if settings.trigger_source == "action" and not self._camera.is_gv_device():
            configuration.refusals.append(
                'trigger_source is "action"; only GigE Vision heads accept actions'
            )
        if self._camera.is_gv_device():
            self._write_packets(settings, configuration.refusals)
        if configuration.refusals:
            return configuration.refusals
        self.chunks, self.chunks_missing = (
            switch_on_chunks(self._features) if settings.chunks else ([], "chunks = false")
        )
        if self.chunks:
            self.chunk_parser = self._camera.create_chunk_parser()
        return self._read_geometry(settings)

    def _read_geometry(self, settings: AravisSettings) -> list[str]:
        """Read size and format of a frame; one sentence per reason why they cannot be used."""
        features = self._features
        try:
            pixel_format = str(features.get("PixelFormat"))
            code = int(self._camera.get_pixel_format())
            width, height = (int(features.get(name)) for name in ("Width", "Height"))
            payload_nbytes = int(self._camera.get_payload())
        except (FeatureError, aravis_error()) as error:
            return [f"the size of its frames cannot be read ({message_of(error)})"]
        packing = packing_of(pixel_format)
        if packing is None:
            return [f"its frames are {pixel_format}, which is not read; set pixel_format"]
        if packing is Packing.WORDS and settings.byte_order == "big":
            packing = Packing.WORDS_BIG_ENDIAN
        self.geometry = FrameGeometry(
            width_px=width,
            height_px=height,
            pixel_format=pixel_format,
            pixel_format_code=code,
            packing=packing,
            payload_nbytes=payload_nbytes,
        )
        if not (width > 0 and height > 0):
            return [f"the head announces frames of {width} x {height} pixels; set its size in it"]
        wrong = [packing_problem(packing, width)]
        needed_nbytes = packed_nbytes(packing, width * height) if wrong == [None] else 0
        if payload_nbytes < needed_nbytes:
            wrong.append(
                f"the head announces {payload_nbytes} bytes for a frame of {width} x {height} "
                f"{pixel_format}, which has {needed_nbytes}"
            )
        return [problem for problem in wrong if problem]

    def _write_packets(self, settings: AravisSettings, refusals: list[str]) -> None:
        library, camera = aravis(), self._camera
        try:
            size = settings.packet_size
            if size == 0:
                # Quirk: the size that Aravis finds may exceed what the path transports. The
                # setting packet_size_limit bounds it. Upstream: AravisProject/aravis#1065.
                size = self._packet_size_of_head(self._passing_packet_size(settings))
            elif size != (allowed := self._packet_size_of_head(size)):
                refusals.append(
                    f"packet_size is {size}; the head takes at most {allowed}, or set 0"
                )
                return
            if size != int(camera.gv_get_packet_size()):
                camera.gv_set_packet_size(size)
            size = int(camera.gv_get_packet_size())
        except aravis_error() as error:
            refusals.append(
                f"packet_size = {settings.packet_size} is refused ({message_of(error)}); set 0, or "
                "a size that the network transports"
            )
            return
        # The size is final: it is not negotiated again when the stream is created.
        camera.gv_set_packet_size_adjustment(library.GvPacketSizeAdjustment.NEVER)
        options = library.GvStreamOption
        camera.gv_set_stream_options(
            options.NONE if settings.packet_socket else options.PACKET_SOCKET_DISABLED
        )
        held, problems = write_pacing(self._features, settings, size, self._read_tick_frequency())
        self._pacing = held
        refusals += problems

    def _passing_packet_size(self, settings: AravisSettings) -> int:
        """The largest size that test packets show to pass; a fixed size is taken as it is."""
        try:
            return min(int(self._camera.gv_auto_packet_size()), settings.packet_size_limit)
        except aravis_error():
            if self._features.is_writable(PACKET_SIZE):
                raise
            return int(self._camera.gv_get_packet_size())

    def _packet_size_of_head(self, size: int) -> int:
        """The next smaller size that the head's description allows."""
        # Quirk: Aravis writes the size through a feature of its own, without the head's limits.
        # Upstream: no report known (2026-11-28); arv_camera_gv_set_packet_size in src/arvcamera.c.
        features = self._features
        if features.kind(PACKET_SIZE) != "integer" or not features.is_writable(PACKET_SIZE):
            return size
        low, high = features.bounds(PACKET_SIZE)
        if not (math.isfinite(low) and low <= size):
            return size
        start, step = int(low), features.increment(PACKET_SIZE)
        return start + (min(size, int(min(high, 65535))) - start) // step * step

    def _read_tick_frequency(self) -> int:
        if not self._camera.is_gv_device():
            return NS_PER_S
        return int(self._camera.get_device().get_timestamp_tick_frequency()) or NS_PER_S

    def _find_latch(self) -> tuple[str, str, bool] | None:
        """Command and value features of the clock, and whether the value is in ns (SFNC 2).

        None if the head has no clock.
        """
        # Quirk: some heads list a latch that they refuse to execute; they have no clock.
        # Upstream: no report known (2026-11-23).
        for command, value, is_ns in CLOCKS:
            if self._features.kind(command) == "command" and self._features.is_available(value):
                with contextlib.suppress(FeatureError):
                    self._features.execute(command)
                    return command, value, is_ns
        return None

    def _frame_settings(self) -> Mapping[str, float | int | str]:
        features = self._features
        found: dict[str, float | int | str] = {
            "ExposureTime": self.exposure_time_us,
            "PixelFormat": self.geometry.pixel_format,
        }
        found.update(self._configuration.gain.settings())
        shifts = features.number("TdiShifts")
        if shifts is not None:
            found["TdiShifts"] = int(shifts)
        if self._camera.is_gv_device():
            found["GevSCPSPacketSize"] = int(self._camera.gv_get_packet_size())
        found.update({name: value for name, value in self._pacing.items() if value})
        return found
