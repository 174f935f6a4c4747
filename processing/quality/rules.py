"""What the rules of the verdict have in common: figures as numbers, limits, and phrases."""

from __future__ import annotations

import math
from collections.abc import Mapping

from processing.quality.report import Figure, Finding, Flag, Verdict


def above(
    figures: Mapping[str, Figure],
    name: str,
    flag: Flag,
    limits: tuple[float, float],
    sentence: str,
) -> list[Finding]:
    """A finding where a figure exceeds the first limit; above the second it asks for a re-fly."""
    value = number(figures, name)
    usable, refly = limits
    if value is None or value <= usable:
        return []
    if value > refly:
        return [Finding(flag, Verdict.REFLY, f"{sentence} Fly it again.", value, refly)]
    return [Finding(flag, Verdict.USABLE, sentence, value, usable)]


def number(figures: Mapping[str, Figure], name: str) -> float | None:
    value = figures.get(name)
    if value is None or isinstance(value, str) or not math.isfinite(value):
        return None
    return float(value)


def probe_bias_phrase(figures: Mapping[str, Figure]) -> str | None:
    """The probe that may be wrong, and by how much, as part of a sentence."""
    off, probe = number(figures, "misread_k"), figures.get("misread_probe")
    if off is None or not probe:
        return None
    return f"probe {probe} reads {abs(off):.1f} K too {'high' if off > 0.0 else 'low'}"
