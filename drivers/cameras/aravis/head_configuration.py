"""Writes the settings of a head into its features, in the order that real heads accept.

What the head holds from earlier is not trusted: acquisition is stopped, automatic functions are
switched off, and every value is read back. All refusals are collected, one sentence each.

Source: GenICam SFNC 2.7; names before SFNC 2 from the descriptions of the heads.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.feature_writer import FeatureWriter
from drivers.cameras.aravis.formats import usual_format
from drivers.cameras.aravis.head_gain import GAINS, HeadGain
from drivers.cameras.aravis.neutral_features import switch_off
from drivers.cameras.aravis.presets import FeatureValue, preset_features
from drivers.cameras.aravis.settings import AravisSettings
from drivers.cameras.aravis.trigger_configuration import (
    switch_triggers_off,
    write_strobe,
    write_trigger,
)

EXPOSURE_TIMES: Final = (
    *("ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw", "ExposureValue"),
    # Quirk: Emergent heads. Upstream: manual: examples of their eSDK, "Exposure" in microseconds.
    "Exposure",
)
"""Exposure time, in microseconds unless the head states another unit; the raw one in units of
`ExposureTimeBaseAbs`."""
EXPOSURE_TOLERANCE: Final = 0.05
"""Heads round an exposure time to rows of their sensor; what they hold is recorded."""
PULSE_WIDTH_MODES: Final = ("Off", "TriggerWidth", "TriggerControlled")
"""Modes of exposure in which no exposure time is used."""
OWN_FEATURES: Final[Mapping[str, str]] = {
    **dict.fromkeys(EXPOSURE_TIMES, "exposure_time_us"),
    **dict.fromkeys(GAINS, "gain_db and gain_unit"),
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

    `written` holds what the head holds afterwards, by feature; `refusals` one sentence per error;
    `missing` what no head can be used without.
    """

    def __init__(self, features: Features, settings: AravisSettings) -> None:
        self._features = features
        self._settings = settings
        self._writer = FeatureWriter(features)
        self.written, self.refusals = self._writer.written, self._writer.refusals
        self.missing = self._writer.missing
        self.exposure_feature = ""
        self.gain = HeadGain(self._writer, settings.gain_unit)

    def write(self) -> None:
        """Write everything that precedes packets and chunks."""
        self._stop()
        switch_triggers_off(self._features)
        # A preset is for a family; what this head does not have is skipped.
        preset = {
            name: value
            for name, value in preset_features(self._settings.preset).items()
            if self._offers(name, value)
        }
        chosen = {**preset, **self._settings.features}
        own = {name for name in chosen if name in OWN_FEATURES and not self.gain.is_stated_by(name)}
        for name in chosen:
            if name in own:
                self.refusals.append(
                    f"features has {name}, which the driver writes itself; set {OWN_FEATURES[name]}"
                )
        held, refusals = switch_off(self._features, chosen)
        self.written.update(held)
        self.refusals += refusals
        for name, value in chosen.items():
            if name not in own:
                self._writer.set(
                    f"features.{name}", name, value, "choose a value that the head has"
                )
        self._write_format()
        self._write_size()
        self._write_exposure_time()
        self.gain.write(self._settings.gain_db)
        self._write_tdi()
        self._write_acquisition_mode()
        write_trigger(self._writer, self._settings)
        write_strobe(self._writer, self._settings)

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
        self.gain.adjust(gain_db)
        if tdi_shifts or features.is_available("TdiShifts"):
            features.set("TdiShifts", tdi_shifts)
        value = self._exposure_value(exposure_time_us)
        features.set(self.exposure_feature, value, tolerance=EXPOSURE_TOLERANCE)

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

    def _offers(self, name: str, value: FeatureValue) -> bool:
        """Whether the head has a feature and, where it is an enumeration, the entry."""
        features = self._features
        if features.kind(name) == "enumeration":
            return value in features.entries(name)
        return features.is_available(name)

    def _stop(self) -> None:
        # A head that still acquires for a killed controller would refuse the other settings.
        features = self._features
        self.lock(True)
        if features.kind("AcquisitionStop") == "command" and features.is_available(
            "AcquisitionStop"
        ):
            self._writer.attempt(
                "acquisition = 'stop'",
                "switch the head off and on",
                lambda: features.execute("AcquisitionStop"),
            )
        self.lock(False)
        if features.kind("AcquisitionStart") != "command":
            self.missing.append("no command AcquisitionStart")

    def _write_format(self) -> None:
        features, wanted = self._features, self._settings.pixel_format
        offered = features.entries("PixelFormat")
        if not offered:
            self.missing.append("no pixel format")
            return
        if not wanted and not features.is_writable("PixelFormat"):
            offered = [features.text("PixelFormat")]
        if not wanted:
            wanted = usual_format(offered, features.text("PixelColorFilter")) or ""
        if not wanted:
            has = ", ".join(name for name in offered if name) or "none that is valid"
            self.missing.append(f"no monochrome or Bayer format of 8 to 16 bits (it has {has})")
        elif wanted not in offered:
            self.refusals.append(f"pixel_format is {wanted!r}; the head has {', '.join(offered)}")
        else:
            self._writer.set("pixel_format", "PixelFormat", wanted, "choose one that the head has")

    def _write_size(self) -> None:
        """The configured size; offsets are zero by now."""
        settings = self._settings
        for key, name, wanted in (
            ("width_px", "Width", settings.width_px),
            ("height_px", "Height", settings.height_px),
        ):
            if not self._features.is_available(name):
                self.missing.append(f"no feature {name}")
            elif wanted:
                self._writer.set(key, name, wanted, "give the size of the sensor")

    def _write_exposure_time(self) -> None:
        features, wanted_us = self._features, self._settings.exposure_time_us
        self._write_exposure_mode()
        offered = [name for name in EXPOSURE_TIMES if features.is_available(name)]
        name = next((name for name in offered if features.unit_us(name) is not None), None)
        if name is None:
            found = f"none of {', '.join(EXPOSURE_TIMES)}"
            if offered:
                found = f"{offered[0]} is in {features.unit(offered[0])!r}"
            self.missing.append(f"no feature that sets its exposure time ({found})")
            return
        self.exposure_feature = name
        unit_us = self._exposure_unit_us()
        low, high = (bound * unit_us for bound in features.bounds(name))
        if low == high == 0.0:
            # A limit that the head computes from what it does not have yet.
            low, high = -math.inf, math.inf
        if not low <= wanted_us <= high:
            self.refusals.append(
                f"exposure_time_us is {wanted_us:g}; the head takes {low:g} to {high:g}"
            )
            return
        hint = "choose a time that the head has"
        held = features.number(name)
        if not features.is_writable(name) and held is not None:
            hint = (
                "its exposure time cannot be set while another feature locks it"
                if features.is_locked(name)
                else f"its exposure time is fixed, set exposure_time_us = {held * unit_us:g}"
            )
        value = self._exposure_value(wanted_us)
        self._writer.set("exposure_time_us", name, value, hint, tolerance=EXPOSURE_TOLERANCE)

    def _write_exposure_mode(self) -> None:
        """A mode in which the exposure time is the head's own; not the width of a pulse."""
        features = self._features
        offered = features.entries("ExposureMode")
        if not offered or features.text("ExposureMode") == "Timed":
            return
        # Quirk: heads from before SFNC 1.5 name the mode in their own words. Any mode in which
        # the exposure time can be written will do.
        # Upstream: manual: GenICam SFNC 2.7, ExposureMode.
        own = [mode for mode in offered if mode not in PULSE_WIDTH_MODES]
        for mode in ("Timed", features.text("ExposureMode"), *own):
            if mode in own:
                hint = "the head has no timed exposure mode"
                self._writer.set("exposure_time_us", "ExposureMode", mode, hint)
                return
        self.refusals.append(
            f"the head has no timed exposure mode (ExposureMode has {', '.join(offered)})"
        )

    def _exposure_unit_us(self) -> float:
        base_us = None
        if self.exposure_feature == "ExposureTimeRaw":
            base_us = self._features.number("ExposureTimeBaseAbs")
        return base_us or self._features.unit_us(self.exposure_feature) or 1.0

    def _exposure_value(self, exposure_time_us: float) -> FeatureValue:
        """The time in the feature's unit, on its step if it is an integer."""
        value = exposure_time_us / self._exposure_unit_us()
        if self._features.kind(self.exposure_feature) != "integer":
            return value
        low, _ = self._features.bounds(self.exposure_feature)
        step = self._features.increment(self.exposure_feature)
        start = int(low) if abs(low) < 1 << 31 else 0
        return start + round((value - start) / step) * step

    def _write_tdi(self) -> None:
        wanted = self._settings.tdi_shifts
        if self._features.is_available("TdiShifts"):
            self._writer.set(
                "tdi_shifts", "TdiShifts", wanted, "choose a number within the head's bounds"
            )
        elif wanted:
            self.refusals.append(
                f"tdi_shifts is {wanted}; the head has no feature TdiShifts, set 0"
            )

    def _write_acquisition_mode(self) -> None:
        if self._features.entries("AcquisitionMode"):
            self._writer.set(
                "acquisition", "AcquisitionMode", "Continuous", "the mode Continuous is needed"
            )
