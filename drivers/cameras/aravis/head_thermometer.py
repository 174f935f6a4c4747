"""The thermometer of a GenICam head: which feature it is, and which of its values are readings.

Source: GenICam SFNC 2.7, DeviceTemperature and DeviceTemperatureSelector.
"""

from __future__ import annotations

import contextlib
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features

TEMPERATURES: Final = ("DeviceTemperature", "TemperatureAbs")
SELECTORS: Final = ("DeviceTemperatureSelector", "TemperatureSelector")
PLACES: Final = ("Sensor", "Sensorboard", "SensorBoard", "Mainboard", "Coreboard")
LIMITS_C: Final = (-60.0, 130.0)


def is_plausible(temperature_c: float) -> bool:
    """Whether a thermometer of a head can have measured a value.

    Args:
        temperature_c: value, degC.

    Returns:
        False outside LIMITS_C, as for a register that is 0 K.

    Example:
        >>> is_plausible(41.5), is_plausible(-273.15)
        (True, False)
    """
    low, high = LIMITS_C
    return low <= temperature_c <= high


def in_celsius(value: float, unit: str) -> float:
    """A temperature in degC.

    Args:
        value: temperature.
        unit: as the description states it; one that is neither kelvin nor Fahrenheit is degC.

    Returns:
        Temperature, degC.

    Example:
        >>> round(in_celsius(300.0, "K"), 2), in_celsius(104.0, "degF"), in_celsius(41.5, "")
        (26.85, 40.0, 41.5)
    """
    name = "".join(character for character in unit.lower() if "a" <= character <= "z")
    if name in ("k", "kelvin"):
        return value - 273.15
    return (value - 32.0) / 1.8 if name in ("f", "degf", "fahrenheit") else value


class HeadThermometer:
    """The thermometer of one head; the sensor's where there are several.

    Args:
        features: the head's features.

    `implausible` counts values that are no readings.
    """

    def __init__(self, features: Features) -> None:
        self._features = features
        for selector in SELECTORS:
            place = features.first_entry(selector, PLACES)
            if place is not None:
                with contextlib.suppress(FeatureError):
                    features.set(selector, place)
        self.feature = features.first_available(TEMPERATURES)
        self.implausible = 0

    def read_c(self) -> float | None:
        """Read it.

        Returns:
            Temperature, degC; None if there is no thermometer, or none that works.
        """
        value = None if self.feature is None else self._features.number(self.feature)
        if value is None:
            return None
        value = in_celsius(value, self._features.unit(self.feature or ""))
        if not is_plausible(value):
            self.implausible += 1
            return None
        return value
