"""One opened V4L2 head: its settings written, its exposure, gain and temperature as they are.

Frames are taken from the node in `drivers.cameras.v4l2.v4l2_head`.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from typing import Final, TypeAlias

from drivers.cameras.v4l2 import uapi
from drivers.cameras.v4l2.control import Control
from drivers.cameras.v4l2.discovery import path_of, serial_number
from drivers.cameras.v4l2.formats import FORMATS, PixelFormat, format_of_code
from drivers.cameras.v4l2.media import graph_of
from drivers.cameras.v4l2.module_parameters import wrong_parameters
from drivers.cameras.v4l2.node import FrameLayout, VideoNode
from drivers.cameras.v4l2.pipeline import SensorPipeline
from drivers.cameras.v4l2.sensor_timing import (
    blanking_for_exposure,
    blanking_for_interval,
    line_time_us,
)
from drivers.cameras.v4l2.settings import V4l2Settings, assignments
from drivers.contract import DeviceError

ABSOLUTE_UNIT_US: Final = 100.0
"""Unit of V4L2_CID_EXPOSURE_ABSOLUTE."""
RECORDED_CLASSES: Final = (
    uapi.CTRL_CLASS_USER,
    uapi.CTRL_CLASS_CAMERA,
    uapi.CTRL_CLASS_IMAGE_SOURCE,
    uapi.CTRL_CLASS_IMAGE_PROC,
)
CLASS_MASK: Final = 0x0FFF_0000
Write: TypeAlias = tuple[str, Control, int]
"""The setting it is for, the control, and its new value."""
NOT_FOUND: Final = (errno.ENOENT, errno.ENXIO, errno.ENODEV)


class V4l2Camera:
    """A head behind an open node.

    Raises:
        DeviceError: it is not there, or refuses settings; all refusals in one message.
    """

    def __init__(self, settings: V4l2Settings) -> None:
        self._settings = settings
        self._pipeline: SensorPipeline | None = None
        self._who = f"{settings.name} at {settings.device}"
        path = path_of(settings.device)
        if path is None:
            raise DeviceError(
                f"{self._who}: there is no such node; check cable and power, and compare "
                "with v4l2-ctl --list-devices"
            )
        try:
            self.node = VideoNode(path)
        except PermissionError:
            raise DeviceError(
                f"{self._who}: {path} may not be opened; add this user to the group video"
            ) from None
        except OSError as error:
            raise DeviceError(
                f"{self._who}: {path} cannot be opened ({_message_of(error)}); check cable and "
                "power"
            ) from None
        try:
            self._configure(settings)
        except OSError as error:
            self.node.close()
            raise DeviceError(
                f"{self._who}: the head was lost while it was set ({_message_of(error)}); check "
                "cable and power"
            ) from None
        except DeviceError:
            self.node.close()
            raise

    @property
    def identity(self) -> dict[str, str]:
        """model, serial, driver, bus and path."""
        return {
            "model": self.node.card,
            "serial": self.serial,
            "driver": f"{self.node.driver} {self.node.kernel}",
            "bus": self.node.bus,
            "path": self.node.path,
            "sensor": "" if self._pipeline is None else self._pipeline.sensor_name,
        }

    def exposure_time_us(self, values: Mapping[str, float | int | str]) -> float | None:
        """The exposure time among control values.

        Args:
            values: as returned by `control_values`.

        Returns:
            Exposure time, us; the configured one if no control reports it, None if there is none.
        """
        if self._exposure is not None and self._exposure.name in values:
            return float(values[self._exposure.name]) * self._exposure_unit_us
        return self._settings.exposure_time_us or None

    def temperature_c(self) -> float | None:
        """Read the head's own thermometer.

        Returns:
            Temperature, degC; None if no control is configured or it cannot be read.

        Raises:
            OSError: ENODEV, the head is lost.
        """
        name = self._settings.temperature_control
        if not name:
            return None
        value = self.node.read_all({name: self.controls[name]}).get(name)
        return None if value is None else value * self._settings.temperature_unit_c

    def control_values(self) -> dict[str, float | int | str]:
        """Read every control of picture and camera.

        Returns:
            Values by name of control, and the pixel format; unreadable controls are omitted.

        Raises:
            OSError: ENODEV, the head is lost.
        """
        chosen = {
            name: control
            for name, control in self.controls.items()
            if control.id & CLASS_MASK in RECORDED_CLASSES or name in self._named
        }
        return {"PixelFormat": self.format.name, **self.node.read_all(chosen)}

    def press_button(self, name: str) -> None:
        """Press a button.

        Args:
            name: name of the control.

        Raises:
            OSError: the head refuses or is lost.
        """
        self.node.write(self.controls[name], 1)

    def adjust(self, exposure_time_us: float, gain_db: float) -> None:
        """Write another exposure time and gain.

        Args:
            exposure_time_us: exposure time, us; rounded to the step of the control.
            gain_db: gain relative to the one at opening, dB.

        Raises:
            DeviceError: the head has no such control, or refuses; it is left as it was.
            OSError: the head is lost.
        """
        writes, refusals = self._adjustments(exposure_time_us, gain_db), list[str]()
        before = [(key, control, self.node.read(control)) for key, control, _ in writes]
        for key, control, value in writes:
            self._write(key, control, value, refusals)
        if refusals:
            for key, control, value in before:
                self._write(key, control, value, [])
            raise DeviceError("\n".join(f"{self._who}: {refusal}" for refusal in refusals))

    def _adjustments(self, exposure_time_us: float, gain_db: float) -> list[Write]:
        settings = self._settings
        if self._exposure is None or not self._exposure_unit_us:
            raise DeviceError(
                f"{self._who}: the head has no control of its exposure time; it cannot be changed "
                "while it runs, set exposure_control if there is one"
            )
        by_id = {c.id: c for c in self.controls.values()}
        writes: list[Write] = []
        if (automatic := by_id.get(uapi.CID_EXPOSURE_AUTO)) is not None:
            writes.append(("exposure_time_us", automatic, uapi.EXPOSURE_MANUAL))
        writes += self._exposure_writes(exposure_time_us)
        if gain_db == self.gain_db:
            return writes
        if not settings.gain_unit_db or self._gain_control is None:
            raise DeviceError(
                f"{self._who}: gain is asked to be {gain_db:g} dB; set gain_unit_db, what a step "
                "of the head's gain is, or [exposure] gain_max_db = 0"
            )
        if (automatic := by_id.get(uapi.CID_AUTOGAIN)) is not None:
            writes.append(("gain_db", automatic, 0))
        value = self._gain_at_0_db + round(gain_db / settings.gain_unit_db)
        return [*writes, ("gain_db", self._gain_control, value)]

    @property
    def gain_db(self) -> float:
        """What the gain is above that of the configuration; 0 where nobody knows its unit."""
        unit_db = self._settings.gain_unit_db
        if not unit_db or self._gain_control is None:
            return 0.0
        return (self.node.read(self._gain_control) - self._gain_at_0_db) * unit_db

    def _configure(self, settings: V4l2Settings) -> None:
        node = self.node
        self.serial = serial_number(node.path)
        if settings.serial and self.serial != settings.serial:
            raise DeviceError(
                f"{self._who}: serial number is {self.serial!r} where {settings.serial!r} is "
                "configured; another head is connected here, or serial is wrong"
            )
        refusals: list[str] = []
        if settings.video_input >= 0:
            try:
                node.set_input(settings.video_input)
            except OSError as error:
                _record_refusal(error)
                refusals.append(
                    f"video_input = {settings.video_input} is refused ({_message_of(error)}); see "
                    "v4l2-ctl --list-inputs"
                )
        refusals += wrong_parameters(settings.module_parameters)
        self._open_pipeline(refusals)
        self.layout = self._write_format(refusals)
        self.format: PixelFormat = FORMATS[settings.pixel_format]
        self.controls = node.controls()
        if settings.frame_interval_s > 0:
            self._write_interval(refusals)
        self._named = {name for name, _ in assignments(settings.controls)}
        self._find_exposure(refusals)
        self._write_controls(refusals)
        gain = self._find_gain()
        self._gain_control = gain if gain is not None and gain.is_readable_number else None
        self._gain_at_0_db = 0 if self._gain_control is None else node.read(self._gain_control)
        if refusals:
            raise DeviceError("\n".join(f"{self._who}: {refusal}" for refusal in refusals))

    def _open_pipeline(self, refusals: list[str]) -> None:
        """Open and configure the parts before a node whose driver leaves them to its user."""
        settings = self._settings
        if not self.node.is_media_centric:
            return
        try:
            graph = graph_of(self.node.path)
            entity = None if graph is None else graph.entity_at(os.path.realpath(self.node.path))
            if graph is None or entity is None:
                raise DeviceError(
                    "its media device is not found below /dev; see media-ctl -p, and whether the "
                    "sensor's driver is loaded"
                )
            self._pipeline = pipeline = SensorPipeline(graph, entity)
        except PermissionError:
            raise DeviceError(
                f"{self._who}: its media device may not be opened; add this user to the group video"
            ) from None
        except DeviceError as error:
            raise DeviceError(f"{self._who}: {error}") from None
        for part in pipeline.parts.values():
            self.node.attach(part)
        refusals += pipeline.configure(settings.width_px, settings.height_px, settings.pixel_format)
        for part in pipeline.side_parts:
            part.close()

    def _write_format(self, refusals: list[str]) -> FrameLayout:
        settings, node = self._settings, self.node
        requested = FORMATS[settings.pixel_format]
        current = node.layout()
        sent = current if self._pipeline is None else self._pipeline.sensor_format
        width = settings.width_px or sent.width_px
        height = settings.height_px or sent.height_px
        try:
            layout = node.set_layout(width, height, requested.code)
        except OSError as error:
            _record_refusal(error)
            refusals.append(
                f"{width} x {height} {requested.name} is refused ({_message_of(error)}); if the "
                "node is busy, end the program that uses it"
            )
            return current
        if layout.code != requested.code:
            offered = [ours.name for ours in map(format_of_code, node.formats()) if ours]
            refusals.append(
                f"pixel_format is {requested.name!r}; the head has "
                + (", ".join(offered) or "no format that is one of ours")
            )
        if (layout.width_px, layout.height_px) != (width, height):
            refusals.append(
                f"width_px x height_px is {width} x {height}; the head gives "
                f"{layout.width_px} x {layout.height_px}"
            )
        return layout

    def _write_interval(self, refusals: list[str]) -> None:
        requested_s = self._settings.frame_interval_s
        if self._pipeline is not None:
            self._write_blanking(requested_s, refusals)
            return
        try:
            granted_s = self.node.set_interval(requested_s)
        except OSError as error:
            _record_refusal(error)
            refusals.append(f"frame_interval_s is {requested_s:g}; the head has none, set 0")
            return
        if abs(granted_s - requested_s) > 0.01 * requested_s:
            refusals.append(f"frame_interval_s is {requested_s:g}; the head gives {granted_s:g}")

    def _write_blanking(self, requested_s: float, refusals: list[str]) -> None:
        """Set the frame interval of a sensor by its blank lines."""
        by_id = {c.id: c for c in self.controls.values()}
        blanking, line_us = by_id.get(uapi.CID_VBLANK), self._line_time_us(by_id)
        if blanking is None or not line_us:
            refusals.append(
                f"frame_interval_s is {requested_s:g}; the sensor does not report its blank lines "
                "and the time of a line, set 0"
            )
            return
        lines = blanking_for_interval(requested_s, line_us, self._sensor_height_px())
        self._write("frame_interval_s", blanking, lines, refusals)

    def _sensor_height_px(self) -> int:
        pipeline = self._pipeline
        return self.layout.height_px if pipeline is None else pipeline.sensor_format.height_px

    def _line_time_us(self, by_id: Mapping[int, Control]) -> float:
        """The time of a line; 0 where the sensor does not report it, or not without ambiguity."""
        rate, blank = by_id.get(uapi.CID_PIXEL_RATE), by_id.get(uapi.CID_HBLANK)
        pipeline = self._pipeline
        if rate is None or blank is None or (pipeline is not None and pipeline.is_scaled):
            return 0.0
        width = self.layout.width_px if pipeline is None else pipeline.sensor_format.width_px
        return line_time_us(width, self.node.read(blank), self.node.read(rate))

    def _find_exposure(self, refusals: list[str]) -> None:
        """The control of the exposure time and its unit."""
        settings, by_id = self._settings, {c.id: c for c in self.controls.values()}
        name = settings.exposure_control
        self._exposure: Control | None = None
        self._exposure_unit_us = settings.exposure_unit_us
        if name == "none":
            return
        if name:
            self._exposure = self.controls.get(name)
            if self._exposure is None:
                refusals.append(self._no_control("exposure_control", name))
        else:
            self._exposure = by_id.get(uapi.CID_EXPOSURE_ABSOLUTE) or by_id.get(uapi.CID_EXPOSURE)
        if self._exposure is not None and not self._exposure_unit_us:
            self._exposure_unit_us = self._unit_of(self._exposure, by_id)
            if not self._exposure_unit_us:
                refusals.append(
                    f"exposure_unit_us is 0, and the head does not report the unit of its control "
                    f"{self._exposure.name}; give it (the time of a line, as a rule; a sensor that "
                    "bins or skips does not report it)"
                )

    def _unit_of(self, control: Control, by_id: Mapping[int, Control]) -> float:
        if control.id == uapi.CID_EXPOSURE_ABSOLUTE:
            return ABSOLUTE_UNIT_US
        return self._line_time_us(by_id) if control.id == uapi.CID_EXPOSURE else 0.0

    def _exposure_writes(self, exposure_time_us: float) -> list[Write]:
        """The exposure in its unit, and before it the blank lines without which it does not fit."""
        assert self._exposure is not None
        steps = max(1, round(exposure_time_us / self._exposure_unit_us))
        write = ("exposure_time_us", self._exposure, steps)
        by_id = {c.id: c for c in self.controls.values()}
        blanking = by_id.get(uapi.CID_VBLANK)
        if blanking is None or self._exposure.id != uapi.CID_EXPOSURE:
            return [write]
        exposure_max = self.node.queried(self._exposure).maximum
        lines = blanking_for_exposure(steps, exposure_max, current := self.node.read(blanking))
        if lines <= current:
            return [write]
        if self._settings.frame_interval_s:
            raise DeviceError(
                f"{self._who}: an exposure of {exposure_time_us:g} us does not fit into a frame of "
                f"{self._settings.frame_interval_s:g} s; shorten it, or set frame_interval_s = 0"
            )
        return [("exposure_time_us", blanking, lines), write]

    def _write_controls(self, refusals: list[str]) -> None:
        settings = self._settings
        by_id = {c.id: c for c in self.controls.values()}
        writes: list[Write] = []
        if settings.exposure_time_us > 0 and settings.exposure_control != "none":
            automatic = by_id.get(uapi.CID_EXPOSURE_AUTO)
            if automatic is not None:
                writes.append(("exposure_time_us", automatic, uapi.EXPOSURE_MANUAL))
            if self._exposure is not None and self._exposure_unit_us:
                writes += self._exposure_writes(settings.exposure_time_us)
            elif self._exposure is None and not settings.exposure_control:
                refusals.append(
                    f"exposure_time_us is {settings.exposure_time_us:g}; the head has no control "
                    'of it, set exposure_control to its name, or to "none" where it is set '
                    "elsewhere"
                )
        if settings.gain >= 0:
            writes += self._gain(by_id, refusals)
        for name, value in assignments(settings.controls):
            control = self.controls.get(name)
            if control is None:
                refusals.append(self._no_control("controls", name))
            else:
                writes.append(("controls", control, value))
        for key in ("temperature_control", "trigger_control"):
            name = getattr(settings, key)
            if name and name not in self.controls:
                refusals.append(self._no_control(key, name))
        for key, control, value in writes:
            self._write(key, control, value, refusals)

    def _gain(self, by_id: Mapping[int, Control], refusals: list[str]) -> list[Write]:
        settings, control = self._settings, self._find_gain()
        if control is None:
            refusals.append(self._no_control("gain_control", settings.gain_control or "gain"))
            return []
        automatic = by_id.get(uapi.CID_AUTOGAIN)
        first = [("gain", automatic, 0)] if automatic is not None else []
        return [*first, ("gain", control, settings.gain)]

    def _find_gain(self) -> Control | None:
        if self._settings.gain_control:
            return self.controls.get(self._settings.gain_control)
        by_id = {c.id: c for c in self.controls.values()}
        return by_id.get(uapi.CID_ANALOGUE_GAIN) or by_id.get(uapi.CID_GAIN)

    def _write(self, key: str, control: Control, value: int, refusals: list[str]) -> None:
        bounded = not control.is_button
        if bounded and not control.minimum <= value <= control.maximum:
            # Another control may have changed the bounds.
            control = self.node.queried(control)
        if bounded and not control.minimum <= value <= control.maximum:
            refusals.append(
                f"{key} would set {control.name} to {value}; the head takes {control.minimum} to "
                f"{control.maximum}"
            )
            return
        try:
            self.node.write(control, value)
        except OSError as error:
            _record_refusal(error)
            refusals.append(
                f"{key}: {control.name} = {value} is refused ({_message_of(error)}); see v4l2-ctl "
                "--list-ctrls-menus"
            )
            return
        if control.is_readable_number and (found := self.node.read(control)) != value:
            refusals.append(f"{key}: {control.name} = {value} became {found}; give a step it has")

    def _no_control(self, key: str, name: str) -> str:
        return f"{key} names {name!r}; the head has {', '.join(self.controls) or 'no controls'}"


def _record_refusal(error: OSError) -> None:
    if error.errno in NOT_FOUND:
        raise error


def _message_of(error: OSError) -> str:
    return error.strerror or str(error)
