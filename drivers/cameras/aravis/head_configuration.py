"""Writes the settings of a head into its features, in the order that real heads accept.

What the head holds from earlier is not trusted: acquisition is stopped, automatic functions are
switched off, and every value is read back. All refusals are collected, one sentence each.

Source: GenICam SFNC 2.7; names before SFNC 2 from the descriptions of the heads.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Final

from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.formats import widest_format
from drivers.cameras.aravis.neutral_features import switch_off
from drivers.cameras.aravis.presets import FeatureValue, preset_features
from drivers.cameras.aravis.settings import AravisSettings

EXPOSURE_TIMES: Final = ("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw", "ExposureValue")
"""Exposure time in microseconds; the raw one in units of `ExposureTimeBaseAbs`."""
GAINS_DB: Final = ("Gain", "GainAbs")
FRAME_TRIGGERS: Final = ("FrameStart", "ExposureStart", "FrameTrigger")
ACQUISITION_TRIGGER: Final = "AcquisitionStart"
TRIGGER_DELAYS: Final = ("TriggerDelay", "TriggerDelayAbs")
DEBOUNCERS: Final = ("LineDebouncerTime", "LineDebouncerTimeAbs", "LineDebounceTime")
CHUNKS: Final = (
    *("Timestamp", "ExposureTime", "CounterValue", "Gain", "Temperature", "FrameID"),
    "Framecounter",
)
COUNTERS: Final = ("Counter1", "Counter0")
COUNTER_EVENTS: Final = ("ExposureStart", "FrameStart", "FrameTrigger", "AcquisitionTrigger")
OWN_FEATURES: Final[Mapping[str, str]] = {
    **dict.fromkeys(EXPOSURE_TIMES, "exposure_time_us"),
    **dict.fromkeys(GAINS_DB, "gain_db"),
    **dict.fromkeys(("Width", "Height"), "width_px and height_px"),
    **dict.fromkeys(("TriggerSource", "TriggerMode", "TriggerSelector"), "trigger_source"),
    "PixelFormat": "pixel_format",
    "TdiShifts": "tdi_shifts",
    "TriggerActivation": "trigger_activation",
    "GevSCPSPacketSize": "packet_size",
    "ChunkModeActive": "chunks",
    "AcquisitionMode": "nothing; it is always Continuous",
}
"""Features that a setting of the driver writes; they are refused under `features`."""


class HeadConfiguration:
    """Writes settings into the features of one head.

    Args:
        features: the head's features.
        settings: the configured settings.

    `written` holds what the head holds afterwards, by feature; `refusals` one sentence per error.
    """

    def __init__(self, features: Features, settings: AravisSettings) -> None:
        self._features = features
        self._settings = settings
        self.written: dict[str, FeatureValue] = {}
        self.refusals: list[str] = []
        self.exposure_feature = ""
        self.gain_feature = ""

    def write(self) -> None:
        """Write everything that precedes packets and chunks."""
        self._stop()
        # A preset is for a family; what this head does not have is skipped.
        preset = {
            name: value
            for name, value in preset_features(self._settings.preset).items()
            if self._features.is_available(name)
        }
        chosen = {**preset, **self._settings.features}
        for name in chosen:
            if name in OWN_FEATURES:
                self.refusals.append(
                    f"features has {name}, which the driver writes itself; set {OWN_FEATURES[name]}"
                )
        held, refusals = switch_off(self._features, chosen)
        self.written |= held
        self.refusals += refusals
        for name, value in chosen.items():
            if name not in OWN_FEATURES:
                self._set(f"features.{name}", name, value, "choose a value that the head has")
        self._write_format()
        self._write_size()
        self._write_exposure_time()
        self._write_gain()
        self._write_tdi()
        self._write_acquisition_mode()
        self._write_trigger()
        self._write_strobe()

    def lock(self, locked: bool) -> None:
        """Report to the description that the stream runs; the start may depend on it.

        Args:
            locked: whether the stream runs (feature TLParamsLocked).
        """
        features = self._features
        if features.kind("TLParamsLocked") == "integer" and features.is_available("TLParamsLocked"):
            with contextlib.suppress(FeatureError):
                features.set("TLParamsLocked", int(locked))

    def adjust(self, exposure_time_us: float, gain_db: float, tdi_shifts: int) -> None:
        """Write exposure settings while the head runs.

        Args:
            exposure_time_us: exposure time, us.
            gain_db: gain, dB.
            tdi_shifts: number of TDI shifts.

        Raises:
            FeatureError: the head refuses one.
        """
        features = self._features
        if self.gain_feature in GAINS_DB or gain_db:
            features.set(self.gain_feature or "Gain", self._gain_value(gain_db))
        if tdi_shifts or features.is_available("TdiShifts"):
            features.set("TdiShifts", tdi_shifts)
        features.set(self.exposure_feature, self._exposure_value(exposure_time_us))

    def exposure_time_us(self) -> float:
        """The exposure time that the head holds.

        Returns:
            Exposure time, us.

        Raises:
            FeatureError: it cannot be read.
        """
        value = self._features.number(self.exposure_feature)
        if value is None:
            raise FeatureError(f"{self.exposure_feature} cannot be read")
        return value * self._exposure_unit_us()

    # Steps

    def _stop(self) -> None:
        # A head that still acquires for a killed controller would refuse the other settings.
        features = self._features
        self.lock(True)
        if features.kind("AcquisitionStop") == "command" and features.is_available(
            "AcquisitionStop"
        ):
            self._try(
                "acquisition = 'stop'",
                "switch the head off and on",
                lambda: features.execute("AcquisitionStop"),
            )
        self.lock(False)
        if features.kind("AcquisitionStart") != "command":
            self.refusals.append(
                "the head has no command AcquisitionStart; it cannot be used as a head"
            )

    def _write_format(self) -> None:
        features, wanted = self._features, self._settings.pixel_format
        offered = features.entries("PixelFormat")
        if not offered:
            self.refusals.append("the head offers no pixel format; it sends no images")
            return
        if not wanted and not features.is_writable("PixelFormat"):
            offered = [features.text("PixelFormat")]
        if not wanted:
            wanted = widest_format(offered) or ""
        if not wanted:
            self.refusals.append(
                "the head has no monochrome or Bayer format of 8 to 16 bits; it has "
                + ", ".join(offered)
            )
        elif wanted not in offered:
            self.refusals.append(f"pixel_format is {wanted!r}; the head has {', '.join(offered)}")
        else:
            self._set("pixel_format", "PixelFormat", wanted, "choose one that the head has")

    def _write_size(self) -> None:
        """The configured size; offsets are zero by now."""
        settings = self._settings
        for key, name, wanted in (
            ("width_px", "Width", settings.width_px),
            ("height_px", "Height", settings.height_px),
        ):
            if not self._features.is_available(name):
                self.refusals.append(f"the head has no feature {name}; its frame size is unknown")
            elif wanted:
                self._set(key, name, wanted, "give the size of the sensor")

    def _write_exposure_time(self) -> None:
        features, wanted_us = self._features, self._settings.exposure_time_us
        if features.entries("ExposureMode") and features.text("ExposureMode") != "Timed":
            self._set(
                "exposure_time_us",
                "ExposureMode",
                "Timed",
                "the head cannot time its exposure by itself",
            )
        name = features.first_available(EXPOSURE_TIMES)
        if name is None:
            self.refusals.append(
                "the head has no feature that sets its exposure time ("
                + ", ".join(EXPOSURE_TIMES)
                + "); it cannot be used"
            )
            return
        self.exposure_feature = name
        unit_us = self._exposure_unit_us()
        low, high = (bound * unit_us for bound in features.bounds(name))
        if not low <= wanted_us <= high:
            self.refusals.append(
                f"exposure_time_us is {wanted_us:g}; the head takes {low:g} to {high:g}"
            )
            return
        value = self._exposure_value(wanted_us)
        self._set("exposure_time_us", name, value, "choose a time that the head has")

    def _exposure_unit_us(self) -> float:
        if self.exposure_feature != "ExposureTimeRaw":
            return 1.0
        return self._features.number("ExposureTimeBaseAbs") or 1.0

    def _exposure_value(self, exposure_time_us: float) -> FeatureValue:
        """The time in the feature's unit, on its step if it is an integer."""
        value = exposure_time_us / self._exposure_unit_us()
        if self._features.kind(self.exposure_feature) != "integer":
            return value
        low, _ = self._features.bounds(self.exposure_feature)
        step = self._features.increment(self.exposure_feature)
        start = int(low) if abs(low) < 1 << 31 else 0
        return start + round((value - start) / step) * step

    def _write_gain(self) -> None:
        features, gain_db = self._features, self._settings.gain_db
        selector = features.first_entry("GainSelector", ("All", "AnalogAll"))
        for digital in ("DigitalAll",):
            if digital in features.entries("GainSelector"):
                with contextlib.suppress(FeatureError):
                    features.set("GainSelector", digital)
                    name = features.first_available((*GAINS_DB, "GainRaw"))
                    if name is not None and features.is_writable(name):
                        features.set(name, self._lowest_gain(name))
        if selector is not None:
            self._set("gain_db", "GainSelector", selector, "the head's gain cannot be set")
        name = features.first_available(GAINS_DB)
        if name is not None:
            self.gain_feature = name
            self._set(
                "gain_db",
                name,
                self._gain_value(gain_db),
                "choose a gain within the head's bounds",
            )
            return
        if gain_db:
            raw = (
                "; it has GainRaw in steps of its own, which features sets"
                * features.is_available("GainRaw")
            )
            self.refusals.append(
                f"gain_db is {gain_db:g}; the head has no gain in dB{raw}; set gain_db = 0"
            )
        elif features.is_available("GainRaw") and "GainRaw" not in self.written:
            self.gain_feature = "GainRaw"
            if features.is_writable("GainRaw"):
                self._set("gain_db", "GainRaw", self._lowest_gain("GainRaw"), "set it in the head")
            else:
                self.written["GainRaw"] = features.get("GainRaw")

    def _gain_value(self, gain_db: float) -> FeatureValue:
        """The gain in dB, raised to the head's lowest if 0 dB is below it."""
        low, high = self._features.bounds(self.gain_feature)
        value = low if gain_db == 0 and 0 < low <= high else gain_db
        return round(value) if self._features.kind(self.gain_feature) == "integer" else value

    def _lowest_gain(self, name: str) -> FeatureValue:
        low, _ = self._features.bounds(name)
        value = 0.0 if low == float("-inf") else max(low, 0.0) if name in GAINS_DB else low
        return int(value) if self._features.kind(name) == "integer" else value

    def _write_tdi(self) -> None:
        wanted = self._settings.tdi_shifts
        if self._features.is_available("TdiShifts"):
            self._set("tdi_shifts", "TdiShifts", wanted, "choose a number within the head's bounds")
        elif wanted:
            self.refusals.append(
                f"tdi_shifts is {wanted}; the head has no feature TdiShifts, set 0"
            )

    def _write_acquisition_mode(self) -> None:
        if self._features.entries("AcquisitionMode"):
            self._set(
                "acquisition", "AcquisitionMode", "Continuous", "the head takes single frames only"
            )

    def _write_trigger(self) -> None:
        settings, features = self._settings, self._features
        if not features.is_available("TriggerMode"):
            self.refusals.append(
                "the head has no feature TriggerMode; it cannot be triggered and is of no use here"
            )
            return
        selectors = features.entries("TriggerSelector")
        frame_trigger = features.first_entry("TriggerSelector", FRAME_TRIGGERS)
        if selectors == [ACQUISITION_TRIGGER]:
            # Quirk: the only trigger of Basler scout and pilot starts every single frame.
            # Upstream: manual: GenICam description of Basler scA1300-32gm, TriggerSelector.
            frame_trigger = ACQUISITION_TRIGGER
        if selectors and frame_trigger is None:
            self.refusals.append(
                "the head has no trigger for single frames (TriggerSelector has "
                f"{', '.join(selectors)}; FrameStart is needed)"
            )
            return
        for other in selectors:
            if other != frame_trigger:
                with contextlib.suppress(FeatureError):
                    features.set("TriggerSelector", other)
                    if features.text("TriggerMode") == "On":
                        features.set("TriggerMode", "Off")
        hint = "choose one that the head has"
        if frame_trigger is not None:
            self._set("trigger_source", "TriggerSelector", frame_trigger, hint)
        with contextlib.suppress(FeatureError):
            features.set("TriggerMode", "Off")
        key, source = {
            "software": ("trigger_source", "Software"),
            "line": ("trigger_line", settings.trigger_line),
            "action": ("trigger_action", settings.trigger_action),
        }[settings.trigger_source]
        # Quirk: some heads accept a source only while the trigger is off, others only while it is
        # on. It is written in both states.
        # Upstream: no report known (2026-11-23); on the order of features,
        # AravisProject/aravis#560.
        with contextlib.suppress(FeatureError):
            features.set("TriggerSource", source)
        self._set("trigger_source", "TriggerMode", "On", "the head cannot be triggered")
        offered = ", ".join(features.entries("TriggerSource")) or "no trigger source"
        self._set(key, "TriggerSource", source, f"the head has {offered}")
        if settings.trigger_source == "line":
            self._write_line()
        delay = features.first_available(TRIGGER_DELAYS)
        if delay is not None:
            self._set("trigger_delay_us", delay, settings.trigger_delay_us, "choose another delay")
        elif settings.trigger_delay_us:
            self.refusals.append(
                f"trigger_delay_us is {settings.trigger_delay_us:g}; the head has no trigger delay"
            )
        if settings.trigger_source == "action":
            self._write_action()

    def _write_line(self) -> None:
        settings, features = self._settings, self._features
        if features.is_available("TriggerActivation"):
            self._set(
                "trigger_activation",
                "TriggerActivation",
                settings.trigger_activation,
                "choose one that the head has",
            )
        elif settings.trigger_activation != "RisingEdge":
            self.refusals.append(
                f"trigger_activation is {settings.trigger_activation!r}; the head triggers on its "
                "own edge only"
            )
        if settings.debounce_us:
            if settings.trigger_line in features.entries("LineSelector"):
                with contextlib.suppress(FeatureError):
                    features.set("LineSelector", settings.trigger_line)
            name = features.first_available(DEBOUNCERS)
            if name is None:
                self.refusals.append(
                    f"debounce_us is {settings.debounce_us:g}; the head has no debouncer"
                )
            else:
                self._set("debounce_us", name, settings.debounce_us, "choose another time")

    def _write_action(self) -> None:
        """Write keys and mask of action commands; a head may have several action signals."""
        features, settings = self._features, self._settings
        number = "".join(c for c in settings.trigger_action if c.isdigit())
        if features.is_available("ActionSelector") and number:
            self._set(
                "trigger_action",
                "ActionSelector",
                int(number),
                "choose an action signal the head has",
            )
        for key, name in (
            ("action_device_key", "ActionDeviceKey"),
            ("action_group_key", "ActionGroupKey"),
            ("action_group_mask", "ActionGroupMask"),
        ):
            # Quirk: heads do not return their keys, so they are not read back.
            # Upstream: manual: GenICam SFNC 2.7, ActionDeviceKey.
            value = int(getattr(settings, key))
            self._try(
                f"{key} = {value!r}",
                "the head accepts no action commands",
                # mypy infers no type for the default of a parameter of a lambda.
                lambda name=name, value=value: features.write_only(name, value),  # type: ignore[misc]
            )

    def _write_strobe(self) -> None:
        line = self._settings.strobe_line
        if not line:
            return
        features = self._features
        if not features.entries("LineSelector"):
            self.refusals.append(f"strobe_line is {line!r}; the head has no LineSelector")
            return
        hint = "the head has " + ", ".join(features.entries("LineSelector"))
        self._set("strobe_line", "LineSelector", line, hint)
        if "Output" in features.entries("LineMode"):
            self._set("strobe_line", "LineMode", "Output", "choose a line that is an output")
        self._set("strobe_line", "LineSource", "ExposureActive", "choose another line")

    # Chunks

    def switch_on_chunks(self) -> list[str]:
        """Let the head append what it knows of each frame.

        Returns:
            Names of the chunks that it appends; empty if it has none.
        """
        features = self._features
        if not features.is_available("ChunkModeActive"):
            return []
        found: list[str] = []
        try:
            features.set("ChunkModeActive", True)
            for chunk in CHUNKS:
                if chunk not in features.entries("ChunkSelector"):
                    continue
                if chunk == "CounterValue" and not self._configure_counter():
                    continue
                with contextlib.suppress(FeatureError):
                    features.set("ChunkSelector", chunk)
                    features.set("ChunkEnable", True)
                    found.append(chunk)
        except FeatureError:
            found = []
        if not found:
            with contextlib.suppress(FeatureError):
                features.set("ChunkModeActive", False)
        return found

    def _configure_counter(self) -> bool:
        """Let a counter count exposures; False if the head's counters cannot."""
        features = self._features
        if not features.entries("CounterEventSource"):
            return not features.entries("CounterSelector")
        counter = features.first_entry("CounterSelector", COUNTERS)
        try:
            if counter is not None:
                features.set("CounterSelector", counter)
            event = features.first_entry("CounterEventSource", COUNTER_EVENTS)
            if event is None:
                return False
            features.set("CounterEventSource", event)
            if "Off" in features.entries("CounterResetSource"):
                features.set("CounterResetSource", "Off")
            if counter is not None and counter in features.entries("ChunkCounterSelector"):
                features.set("ChunkCounterSelector", counter)
            if features.is_available("CounterReset"):
                features.execute("CounterReset")
        except FeatureError:
            return False
        return True

    # Helpers

    def _set(self, key: str, name: str, value: FeatureValue, hint: str) -> None:
        try:
            self.written[name] = self._features.set(name, value)
        except FeatureError as error:
            self.refusals.append(f"{key} = {value!r} is refused ({error}); {hint}")

    def _try(self, what: str, hint: str, action: Callable[[], Any]) -> None:
        try:
            action()
        except FeatureError as error:
            self.refusals.append(f"{what} is refused ({error}); {hint}")
