"""One opened GenICam head: its settings, clock, temperature and trigger.

Frames are in `drivers.cameras.aravis.stream`; opening, loss and reconnection are in
`drivers.cameras.aravis.aravis_head`.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from drivers.cameras.aravis.camera_access import local_interface, open_camera
from drivers.cameras.aravis.formats import packing_of, packing_problem
from drivers.cameras.aravis.gvcp import GVCP_PORT, is_ip_address
from drivers.cameras.aravis.library import aravis, aravis_error, message_of
from drivers.cameras.aravis.packet_filter import ControlSocketFilter, SocketCapture
from drivers.cameras.aravis.settings import AravisSettings
from drivers.cameras.pixels import Packing
from drivers.contract import DeviceError

LATCH_ATTEMPTS: Final = 3
NS_PER_S: Final = 1_000_000_000
SETTINGS_HISTORY_LENGTH: Final = 4
EXPOSURE_TIME_TOLERANCE: Final = 0.01
"""Relative tolerance between a frame's exposure time and the configured one; heads round it."""
CHUNKS: Final = ("Timestamp", "ExposureTime", "CounterValue", "Gain", "Temperature", "FrameID")


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


class ControlDeniedError(DeviceError):
    """Another program controls the head."""


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
        self.identity = self._identity(settings)
        refusals = self._configure(settings)
        if refusals:
            raise DeviceError("\n".join(f"{self._who}: {refusal}" for refusal in refusals))
        self._tick_hz = self._read_tick_frequency()
        self._latch_features = self._find_latch()
        self._has_temperature = self._has("DeviceTemperature")
        self.exposure_time_us = float(self._camera.get_exposure_time())
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
        """Whether Aravis' heartbeat has found that the head no longer accepts control.

        The state is polled. The signal "control-lost" is not used: while it is emitted, the
        heartbeat's thread holds a reference to the device. If the driver released the device in
        that time, this reference would be the last one. The thread would then join itself, and
        GLib aborts.
        """
        camera = self._camera
        return bool(camera.is_gv_device() and not camera.get_device().is_controller())

    def start(self) -> None:
        self._camera.start_acquisition()

    def stop(self) -> None:
        """Stop acquisition; errors of a lost head are ignored."""
        with contextlib.suppress(aravis_error()):
            self._camera.stop_acquisition()

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
        """Make the head send a test packet to the stream's port; some heads cannot."""
        with contextlib.suppress(aravis_error()):
            self._camera.get_device().execute_command("ArvGevSCPSFireTestPacket")

    def other_senders(self) -> int:
        """Number of dropped datagrams of other senders at the control socket."""
        return 0 if self._control is None else self._control.dropped_datagrams()

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Write exposure settings while the head runs; features that it does not have are skipped.

        Raises:
            DeviceError: it refuses one.
        """
        camera = self._camera
        try:
            if gain_db != 0 or self._has("Gain"):
                camera.set_float("Gain", gain_db)
            if tdi_shifts != 0 or self._has("TdiShifts"):
                camera.set_integer("TdiShifts", tdi_shifts)
            camera.set_exposure_time(exposure_time_us)
            self._earlier.append(self.frame_settings)
            self.exposure_time_us = float(camera.get_exposure_time())
            self.frame_settings = self._frame_settings()
        except aravis_error() as error:
            raise DeviceError(
                f"{self._who}: {exposure_time_us:g} us, {gain_db:g} dB, {tdi_shifts} TDI shifts "
                f"are refused ({message_of(error)}); choose settings within the head's bounds"
            ) from None

    def settings_of(self, exposure_us: float | None) -> Mapping[str, float | int | str]:
        """The settings of a frame, by its exposure time; they may be from before `adjust`."""
        for settings in (self.frame_settings, *reversed(self._earlier)):
            time_us = float(settings["ExposureTime"])
            if (
                exposure_us is None
                or abs(time_us - exposure_us) <= EXPOSURE_TIME_TOLERANCE * time_us
            ):
                return settings
        return self.frame_settings

    def software_trigger(self) -> None:
        """Fire the software trigger; raises the error of Aravis."""
        self._camera.software_trigger()

    def latch(self) -> ClockLatch | None:
        """Read the head's clock; the best of three attempts. None if the head has no latch."""
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

    def temperature_c(self) -> float | None:
        """DeviceTemperature; None if the head has none."""
        return float(self._camera.get_float("DeviceTemperature")) if self._has_temperature else None

    def check_alive(self) -> None:
        """Read a feature that is not cached; raises the error of Aravis."""
        self._camera.get_exposure_time()

    def ns_from_ticks(self, ticks: int) -> int:
        """Device clock in ns; exact also for a tick frequency that is no power of ten."""
        return ticks * NS_PER_S // self._tick_hz

    # Reading and writing features

    def _has(self, feature: str) -> bool:
        failed = aravis_error()
        try:
            return bool(self._camera.is_feature_available(feature))
        except failed:
            return False

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
            except failed:
                identity[key] = ""
        if settings.serial and identity["serial"] != settings.serial:
            raise DeviceError(
                f"{self._who}: serial number is {identity['serial']!r} where {settings.serial!r} "
                "is configured; another head is connected here, or serial is wrong"
            )
        return identity

    def _configure(self, settings: AravisSettings) -> list[str]:
        """Write every setting; returns one sentence per refusal."""
        library, failed = aravis(), aravis_error()
        camera = self._camera
        refusals: list[str] = []

        def write(key: str, value: object, action: Callable[[], object], hint: str) -> None:
            try:
                action()
            except failed as error:
                refusals.append(f"{key} = {value!r} is refused ({message_of(error)}); {hint}")

        # A head that still acquires for a killed controller would refuse the other settings.
        write("acquisition", "stop", camera.stop_acquisition, "switch the head off and on")
        self._write_format(settings, write, refusals)
        self._write_exposure(settings, write, refusals)
        write(
            "acquisition",
            "continuous",
            lambda: camera.set_acquisition_mode(library.AcquisitionMode.CONTINUOUS),
            "this head cannot be used",
        )
        key, source = {
            "software": ("trigger_source", "Software"),
            "line": ("trigger_line", settings.trigger_line),
            "action": ("trigger_action", settings.trigger_action),
        }[settings.trigger_source]
        try:
            sources = camera.dup_available_trigger_sources()
        except failed:
            sources = []
        write(
            key,
            source,
            lambda: camera.set_trigger(source),
            "the head has " + (", ".join(sources) or "no trigger"),
        )
        if settings.trigger_source == "action":
            self._write_action(settings, write, refusals)
        if camera.is_gv_device():
            self._write_packets(settings, write)
        if refusals:
            return refusals
        if settings.chunks and self._switch_on_chunks():
            self.chunk_parser = camera.create_chunk_parser()
        _, _, width, height = (int(n) for n in _region(camera))
        packing = packing_of(str(camera.get_pixel_format_as_string()))
        assert packing is not None, "the settings allow no other format"
        self.geometry = FrameGeometry(
            width_px=width,
            height_px=height,
            pixel_format=str(camera.get_pixel_format_as_string()),
            pixel_format_code=int(camera.get_pixel_format()),
            packing=packing,
            payload_nbytes=int(camera.get_payload()),
        )
        wrong = packing_problem(packing, width)
        return [wrong] if wrong else []

    def _write_action(
        self, settings: AravisSettings, write: Callable[..., None], refusals: list[str]
    ) -> None:
        """Write keys and mask of action commands; a head may have several action signals."""
        camera = self._camera
        if not camera.is_gv_device():
            refusals.append('trigger_source is "action"; only GigE Vision heads accept actions')
            return
        number = "".join(c for c in settings.trigger_action if c.isdigit())
        if self._has("ActionSelector") and number:
            write(
                "trigger_action",
                settings.trigger_action,
                lambda: camera.set_integer("ActionSelector", int(number)),
                "choose an action signal the head has",
            )
        for key, feature in (
            ("action_device_key", "ActionDeviceKey"),
            ("action_group_key", "ActionGroupKey"),
            ("action_group_mask", "ActionGroupMask"),
        ):
            value = getattr(settings, key)
            write(
                key,
                value,
                functools.partial(camera.set_integer, feature, value),
                "the head accepts no action commands",
            )

    def _write_format(
        self, settings: AravisSettings, write: Callable[..., None], refusals: list[str]
    ) -> None:
        camera, failed = self._camera, aravis_error()
        try:
            formats = list(camera.dup_available_pixel_formats_as_strings())
        except failed:
            formats = []
        if formats and settings.pixel_format not in formats:
            refusals.append(
                f"pixel_format is {settings.pixel_format!r}; the head has {', '.join(formats)}"
            )
        else:
            write(
                "pixel_format",
                settings.pixel_format,
                lambda: camera.set_pixel_format_from_string(settings.pixel_format),
                "choose one that the head has",
            )
        if settings.width_px:
            width, height = settings.width_px, settings.height_px
            if tuple(_region(camera))[2:] != (width, height):
                write(
                    "width_px, height_px",
                    (width, height),
                    lambda: camera.set_region(0, 0, width, height),
                    "give the size of the sensor",
                )
                if not refusals and tuple(_region(camera))[2:] != (width, height):
                    found = " x ".join(str(n) for n in tuple(_region(camera))[2:])
                    refusals.append(
                        f"width_px x height_px is {width} x {height}; the head gives {found}"
                    )

    def _write_exposure(
        self, settings: AravisSettings, write: Callable[..., None], refusals: list[str]
    ) -> None:
        camera, failed = self._camera, aravis_error()
        try:
            low_us, high_us = camera.get_exposure_time_bounds()
        except failed:
            low_us, high_us = 0.0, float("inf")
        if not low_us <= settings.exposure_time_us <= high_us:
            refusals.append(
                f"exposure_time_us is {settings.exposure_time_us:g}; the head takes {low_us:g} to "
                f"{high_us:g}"
            )
        else:
            write(
                "exposure_time_us",
                settings.exposure_time_us,
                lambda: camera.set_exposure_time(settings.exposure_time_us),
                "the head cannot set its exposure time",
            )
        if self._has("Gain"):
            write(
                "gain_db",
                settings.gain_db,
                lambda: camera.set_float("Gain", settings.gain_db),
                "choose a gain within the head's bounds",
            )
        elif settings.gain_db != 0:
            refusals.append(
                f"gain_db is {settings.gain_db:g}; the head has no feature Gain in dB, set 0"
            )
        if self._has("TdiShifts"):
            write(
                "tdi_shifts",
                settings.tdi_shifts,
                lambda: camera.set_integer("TdiShifts", settings.tdi_shifts),
                "choose a number within the head's bounds",
            )
        elif settings.tdi_shifts != 0:
            refusals.append(
                f"tdi_shifts is {settings.tdi_shifts}; the head has no feature TdiShifts, set 0"
            )

    def _write_packets(self, settings: AravisSettings, write: Callable[..., None]) -> None:
        library, camera = aravis(), self._camera

        def set_size() -> None:
            size = settings.packet_size
            if size == 0:
                size = min(int(camera.gv_auto_packet_size()), settings.packet_size_limit)
            camera.gv_set_packet_size(size)

        write(
            "packet_size",
            settings.packet_size,
            set_size,
            "set 0, or a size that the network transports",
        )
        # The size is final; otherwise Aravis would negotiate again when the stream is created.
        camera.gv_set_packet_size_adjustment(library.GvPacketSizeAdjustment.NEVER)
        options = library.GvStreamOption
        camera.gv_set_stream_options(
            options.NONE if settings.packet_socket else options.PACKET_SOCKET_DISABLED
        )

    def _switch_on_chunks(self) -> bool:
        camera, failed = self._camera, aravis_error()
        try:
            if not camera.are_chunks_available():
                return False
            camera.set_chunk_mode(True)
            if self._has("ChunkSelector"):
                offered = camera.dup_available_enumerations_as_strings("ChunkSelector")
                for chunk in CHUNKS:
                    if chunk in offered:
                        camera.set_chunk_state(chunk, True)
        except failed:
            return False
        return True

    def _read_tick_frequency(self) -> int:
        if not self._camera.is_gv_device():
            return NS_PER_S
        return int(self._camera.get_device().get_timestamp_tick_frequency()) or NS_PER_S

    def _find_latch(self) -> tuple[str, str, bool] | None:
        """Command and value features of the clock, and whether the value is in ns (SFNC 2)."""
        for command, value, is_ns in (
            ("TimestampLatch", "TimestampLatchValue", True),
            ("GevTimestampControlLatch", "GevTimestampValue", False),
        ):
            if self._has(command) and self._has(value):
                return command, value, is_ns
        return None

    def _frame_settings(self) -> Mapping[str, float | int | str]:
        camera = self._camera
        found: dict[str, float | int | str] = {
            "ExposureTime": self.exposure_time_us,
            "PixelFormat": self.geometry.pixel_format,
        }
        if self._has("Gain"):
            found["Gain"] = float(camera.get_float("Gain"))
        elif self._has("GainRaw"):
            found["GainRaw"] = int(camera.get_integer("GainRaw"))
        if self._has("TdiShifts"):
            found["TdiShifts"] = int(camera.get_integer("TdiShifts"))
        if camera.is_gv_device():
            found["GevSCPSPacketSize"] = int(camera.gv_get_packet_size())
        return found


def _region(camera: Any) -> tuple[int, int, int, int]:
    region = camera.get_region()
    return tuple(region)
