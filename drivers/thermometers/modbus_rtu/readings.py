"""Temperatures out of Modbus registers: scaled words and 32-bit floats in both word orders.

Requests and replies are in `drivers.thermometers.modbus_rtu.frames`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from drivers import DriverError

WORDS: Final = {"int16": 1, "uint16": 1, "float32": 2}
"""Registers per channel, by the type of its value."""
ABSOLUTE_ZERO_C: Final = -273.15
MAX_TEMPERATURE_C: Final = 2000.0
MIN_NONZERO: Final = 1e-6
"""A value nearer to 0 is no reading: a float of few digits has it with its words swapped."""


class ImplausibleReadingError(DriverError, ValueError):
    """A register holds a number that is no temperature; `value_c` is that number."""

    def __init__(self, value_c: float) -> None:
        super().__init__(f"{value_c:g} degC is no temperature")
        self.value_c = value_c


@dataclass(frozen=True)
class ReadingFormat:
    """How registers hold a temperature.

    Args:
        value_type: "int16", "uint16" or "float32" (IEEE 754).
        word_order: "big" if the first register of a float is its upper half, else "little".
        scale_c: degC per unit of the value.
        offset_c: degC of the value 0.
        open_sensor: register of an open sensor, for 16 bit.
    """

    value_type: str = "int16"
    word_order: str = "big"
    scale_c: float = 0.1
    offset_c: float = 0.0
    open_sensor: int = 0x7FFF

    @property
    def words(self) -> int:
        """Registers per channel."""
        return WORDS[self.value_type]

    def temperature_c(self, registers: Sequence[int]) -> float | None:
        """The temperature of one channel.

        Args:
            registers: the `words` registers of the channel, unsigned, in the order received.

        Returns:
            The temperature in degC; None if the sensor is open (not a number, for floats).

        Raises:
            ImplausibleReadingError: below absolute zero, above 2000 degC, or a float so near 0
                that its words must be swapped.

        Example:
            >>> ReadingFormat().temperature_c([65484])
            -5.2
            >>> ReadingFormat("float32", scale_c=1.0).temperature_c([0x41AC, 0x0000])
            21.5
        """
        value = self._value(registers)
        if value is None:
            return None
        # A scale such as 0.1 or 0.01 has no exact float; its inverse has.
        inverse = round(1 / self.scale_c)
        is_decimal = math.isclose(inverse * self.scale_c, 1.0, rel_tol=1e-12)
        value_c = (value / inverse if is_decimal else value * self.scale_c) + self.offset_c
        is_swapped = self.value_type == "float32" and 0 < abs(value) < MIN_NONZERO
        if is_swapped or not ABSOLUTE_ZERO_C <= value_c <= MAX_TEMPERATURE_C:
            raise ImplausibleReadingError(value_c)
        return value_c

    def word_order_evidence(self, registers: Sequence[int]) -> int:
        """Whether the float of one channel is a temperature in the configured word order only.

        Args:
            registers: the two registers of the channel, unsigned, in the order received.

        Returns:
            1 if it is one in the configured order only, -1 if in the other order only, else 0.

        Example:
            >>> ReadingFormat("float32", "big", 1.0).word_order_evidence([0x41AC, 0])
            1
            >>> ReadingFormat("float32", "little", 1.0).word_order_evidence([0x41AC, 0])
            -1
        """
        other = replace(self, word_order="little" if self.word_order == "big" else "big")
        return int(self._is_temperature(registers)) - int(other._is_temperature(registers))

    def _is_temperature(self, registers: Sequence[int]) -> bool:
        try:
            return self.temperature_c(registers) is not None
        except ImplausibleReadingError:
            return False

    def _value(self, registers: Sequence[int]) -> float | None:
        if self.value_type == "float32":
            upper, lower = registers if self.word_order == "big" else reversed(registers)
            number: float = struct.unpack(">f", struct.pack(">HH", upper, lower))[0]
            if math.isnan(number):
                return None
            return number
        register = registers[0]
        if register == self.open_sensor:
            return None
        if self.value_type == "int16" and register & 0x8000:
            return register - 0x10000
        return register
