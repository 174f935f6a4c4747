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
        if not is_plausible(value):
            self.implausible += 1
            return None
        return value
