"""Gain of a head: which feature it is, its unit, and its value for a gain in dB.

The standard gives the gain no unit. It is taken as dB or as a factor only where the description
states it, by its unit or its text; otherwise the head keeps its lowest gain, which is recorded as
of unknown unit.

Source: GenICam SFNC 2.7, Gain (unit "-"); names before SFNC 2 from the descriptions of the heads.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping
from enum import Enum
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.feature_writer import FeatureWriter
from drivers.cameras.aravis.presets import FeatureValue

GAINS: Final = ("Gain", "GainAbs")
RAW_GAIN: Final = "GainRaw"
"""Gain in steps of the head's own."""
MAKERS_OF_FACTORS: Final = ("JAI",)
# Quirk: JAI heads state no unit; their gain is a factor, 1 for 0 dB.
# Upstream: manual: JAI GO-2401M-PGE user manual, "Gain control" (setting value 16.0 is 24 dB).
TEXT_OF_DECIBELS: Final = re.compile(r"\bdecibels?\b|\bdB\b", re.IGNORECASE)
TEXT_OF_STEPS: Final = re.compile(r"\d\s*(?:dB|decibel)", re.IGNORECASE)
"""A number before dB may be the size of a step."""
TEXT_OF_FACTOR: Final = re.compile(r"factor|multipl", re.IGNORECASE)
TOLERANCE_DB: Final = 0.5
"""Heads round a gain to their steps; what they hold is recorded."""
UNIT: Final = "GainUnit"
"""Key of the unit in the settings of a frame."""


class GainUnit(Enum):
    """The unit of a gain; the value is recorded with every frame."""

    DECIBEL = "dB"
    FACTOR = "factor"
    UNKNOWN = "unknown"


UNITS: Final[Mapping[str, GainUnit]] = {
    **dict.fromkeys(("db", "decibel", "decibels"), GainUnit.DECIBEL),
    **dict.fromkeys(("x", "times", "factor"), GainUnit.FACTOR),
}
"""Units as descriptions state them, in lower case."""


class HeadGain:
    """The gain of one head.

    Args:
        writer: of the head's features.
        stated_unit: value of a `GainUnit` that the configuration states; empty to read it from
            the description.

    `feature` is the feature that holds it, and `unit` its unit; empty and unknown before `write`,
    and if the head has none.
    """

    def __init__(self, writer: FeatureWriter, stated_unit: str) -> None:
        self._writer = writer
        self._features = writer.features
        self._stated_unit = stated_unit
        self.feature = ""
        self.unit = GainUnit.UNKNOWN

    def write(self, gain_db: float) -> None:
        """Find the gain and write it.

        Args:
            gain_db: gain, dB; 0 is the head's lowest where its unit is unknown.
        """
        features = self._features
        selector = features.first_entry("GainSelector", ("All", "AnalogAll", "SensorAll"))
        if "DigitalAll" in features.entries("GainSelector"):
            with contextlib.suppress(FeatureError):
                features.set("GainSelector", "DigitalAll")
                name = features.first_available((*GAINS, RAW_GAIN))
                if name is not None and features.is_writable(name):
                    features.set(name, self._lowest(name))
        if selector is not None:
            self._writer.set("gain_db", "GainSelector", selector, "the head's gain cannot be set")
        self.feature = features.first_available((*GAINS, RAW_GAIN)) or ""
        self.unit = unit_of(features, self.feature, self._stated_unit)
        if self.unit is not GainUnit.UNKNOWN:
            self._write_known(gain_db)
        elif gain_db:
            self._writer.refusals.append(self._no_gain_in_db(gain_db))
        elif self.feature and self.feature not in self._writer.written:
            self._write_lowest()

    def is_stated_by(self, name: str) -> bool:
        """Whether the configuration may state a feature by name: a gain of unknown unit.

        Args:
            name: GenICam name.

        Returns:
            False if the driver writes it.
        """
        return name in GAINS and unit_of(self._features, name) is GainUnit.UNKNOWN

    def adjust(self, gain_db: float) -> None:
        """Write another gain while the head runs.

        Args:
            gain_db: gain, dB.

        Raises:
            FeatureError: the head refuses it, or its unit is unknown.
        """
        if self.unit is not GainUnit.UNKNOWN:
            value = self._value(gain_db)
            self._features.set(self.feature, value, within=self._tolerance(value))
        elif gain_db:
            raise FeatureError(self._no_gain_in_db(gain_db))

    def settings(self) -> Mapping[str, float | int | str]:
        """What the head holds, as frames record it.

        Returns:
            `Gain` and its unit, or `GainRaw`; empty if the head has no gain.
        """
        name = self.feature
        if self._features.kind(name) not in ("integer", "float"):
            return {}
        value = self._features.number(name)
        if value is None:
            return {}
        return {RAW_GAIN: int(value)} if name == RAW_GAIN else self.reported(value)

    def reported(self, value: float) -> Mapping[str, float | int | str]:
        """A gain that the head reports, as frames record it.

        Args:
            value: in the unit of the head's gain.

        Returns:
            `Gain` and its unit.
        """
        return {"Gain": value, UNIT: self.unit.value}

    def _write_known(self, gain_db: float) -> None:
        features, name = self._features, self.feature
        is_factor = self.unit is GainUnit.FACTOR
        hint, held = "choose a gain within the head's bounds", features.number(name)
        if not features.is_writable(name):
            hint = "its gain cannot be set"
            if held is not None:
                held_db = 20.0 * math.log10(held) if is_factor and held > 0 else held
                hint += f"; set gain_db = {held_db:g}"
        key = f"gain_db = {gain_db:g}, as the factor {name}" if is_factor else "gain_db"
        value = self._value(gain_db)
        self._writer.set(key, name, value, hint, within=self._tolerance(value))

    def _write_lowest(self) -> None:
        features, name = self._features, self.feature
        if features.kind(name) in ("integer", "float") and features.is_writable(name):
            self._writer.set("gain_db", name, self._lowest(name), "set it in the head")
            return
        with contextlib.suppress(FeatureError):
            self._writer.written[name] = features.get(name)

    def _no_gain_in_db(self, gain_db: float) -> str:
        raw, cure = "", "set gain_db = 0"
        if self.feature == RAW_GAIN:
            raw = f"; it has {RAW_GAIN} in steps of its own, which features sets"
        elif self.feature:
            stated = self._features.unit(self.feature)
            raw = f"; it has {self.feature} " + (f"in {stated!r}" if stated else "without a unit")
            cure += ", or gain_unit to dB or factor as its manual states"
        return f"gain_db is {gain_db:g}; the head has no gain in dB{raw}; {cure}"

    def _value(self, gain_db: float) -> FeatureValue:
        """The gain in the feature's unit, raised to the head's lowest if 0 dB is below it."""
        low, high = self._features.bounds(self.feature)
        wanted = 10.0 ** (gain_db / 20.0) if self.unit is GainUnit.FACTOR else gain_db
        value = low if gain_db == 0 and wanted < low <= high else wanted
        return round(value) if self._features.kind(self.feature) == "integer" else value

    def _tolerance(self, value: FeatureValue) -> float:
        """TOLERANCE_DB in the unit of the feature."""
        if self.unit is GainUnit.FACTOR:
            return abs(float(value)) * (math.pow(10.0, TOLERANCE_DB / 20.0) - 1.0)
        return TOLERANCE_DB

    def _lowest(self, name: str) -> FeatureValue:
        low, _ = self._features.bounds(name)
        value = 0.0 if low == float("-inf") else max(low, 0.0) if name in GAINS else low
        return int(value) if self._features.kind(name) == "integer" else value


def unit_of(features: Features, name: str, stated_unit: str = "") -> GainUnit:
    """The unit of a feature that holds a gain.

    Args:
        features: the head's features.
        name: GenICam name.
        stated_unit: value of a `GainUnit` that the configuration states; empty without.

    Returns:
        What the configuration states; else what the unit in the description states; without a
        unit, dB or a factor if its text names one of them. A factor has a lowest value of 1.
    """
    if name not in GAINS or features.kind(name) not in ("integer", "float"):
        return GainUnit.UNKNOWN
    if stated_unit:
        return GainUnit(stated_unit)
    unit, text = features.unit(name).lower().strip("[]() "), features.description(name)
    if unit:
        return UNITS.get(unit, GainUnit.UNKNOWN)
    if features.text("DeviceVendorName").startswith(MAKERS_OF_FACTORS):
        return GainUnit.FACTOR
    if TEXT_OF_DECIBELS.search(text):
        return GainUnit.UNKNOWN if TEXT_OF_STEPS.search(text) else GainUnit.DECIBEL
    low, _ = features.bounds(name)
    is_factor = TEXT_OF_FACTOR.search(text) and features.kind(name) == "float" and low == 1.0
    return GainUnit.FACTOR if is_factor else GainUnit.UNKNOWN
