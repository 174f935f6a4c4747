"""Numbers in ASCII text, by the type of their field; what a field means is in the decoders.

Python's own `int` and `float` accept more than receivers send: "nan", "inf", underscores, blanks,
and as exponents what is hexadecimal ("2e000343").
"""

from __future__ import annotations

import math
import re
from typing import Final

_INTEGER: Final = re.compile(r"[-+]?[0-9]{1,18}")
_DECIMAL: Final = re.compile(
    r"[-+]?([0-9]{1,20}(\.[0-9]{0,30})?|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?"
)


def parse_integer(text: str) -> int:
    """The value of a field of a whole number.

    Args:
        text: an optional sign and 1 to 18 digits.

    Returns:
        The number.

    Raises:
        ValueError: it is empty or anything else, "1.0" and "1_0" too.

    Example:
        >>> parse_integer("2445")
        2445
    """
    if _INTEGER.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a whole number")
    return int(text)


def parse_decimal(text: str) -> float:
    """The value of a field of a finite decimal number, with or without an exponent.

    Args:
        text: an optional sign, digits with or without a decimal point, an optional exponent.

    Returns:
        The number.

    Raises:
        ValueError: it is empty, not finite or anything else.

    Example:
        >>> parse_decimal("-1.5e-03")
        -0.0015
    """
    value = float(text) if _DECIMAL.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not a decimal number")
    return value
