"""Types of values in files, with the limits that validation and JSON Schemas share.

Which keys have them is in the models of the files.
"""

from __future__ import annotations

import re
from typing import Annotated, Final

from pydantic import AfterValidator, Field, Strict

NUMBER_LIMIT: Final = 1e12
"""No length, angle, count or coefficient of a camera, in the units of the file, comes near."""
_NAME_PATTERN: Final = r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,63}"
_NAME: Final = re.compile(_NAME_PATTERN)


def plain_name(name: str) -> bool:
    """Whether a sensor or file name is safe in a path: letters, digits, `_`, `-`, inner dots.

    Args:
        name: to be checked.

    Returns:
        True where it is safe and has 64 characters at most.

    Example:
        >>> plain_name("SU-01.raw"), plain_name("../SU01"), plain_name(".hidden")
        (True, False, False)
    """
    return _NAME.fullmatch(name) is not None and ".." not in name


def _visible(text: str) -> str:
    if not text.isprintable():
        raise ValueError("its characters are all visible")
    return text


def named(text: str) -> str:
    """The text, if it is safe in a path.

    Args:
        text: to be checked by `plain_name`.

    Returns:
        The text itself.

    Raises:
        ValueError: it is not safe.
    """
    if not plain_name(text):
        raise ValueError("letters, digits, '_', '-' and inner dots only, 64 at most")
    return text


Flag = Annotated[bool, Strict()]
Text = Annotated[str, Strict(), Field(max_length=1000), AfterValidator(_visible)]
Name = Annotated[
    str,
    Strict(),
    AfterValidator(named),
    Field(json_schema_extra={"pattern": f"^{_NAME_PATTERN}$"}),
]
"""A text that is safe as a file name."""
Number = Annotated[float, Strict(), Field(ge=-NUMBER_LIMIT, le=NUMBER_LIMIT, allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, le=NUMBER_LIMIT, allow_inf_nan=False)]
Triple = tuple[Number, Number, Number]
