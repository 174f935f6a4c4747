"""Formulas as MathML at build time, so that a page needs neither a script nor a font."""

from __future__ import annotations

import html
import re
from typing import Final

from latex2mathml.converter import convert

_UNKNOWN: Final = re.compile(r"<m[a-z]+>[^<]*(\\[A-Za-z]+)")
_FORMULA: Final = re.compile(
    r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL
)


def with_mathml(page: str) -> str:
    """A page with every formula that `pymdownx.arithmatex` marked as MathML.

    Raises:
        ValueError: a formula has a command that latex2mathml does not know.
    """
    return _FORMULA.sub(_mathml, page)


def _mathml(found: re.Match[str]) -> str:
    formula = html.unescape(found[3]).strip()
    is_block = found[2] == "["
    converted = convert(formula, display="block" if is_block else "inline")
    unknown = _UNKNOWN.search(converted)
    if unknown:
        raise ValueError(f"formula {formula!r}: {unknown[1]} is unknown; write it otherwise")
    return f'<div class="formula">{converted}</div>' if is_block else converted
