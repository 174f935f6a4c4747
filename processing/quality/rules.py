"""What the rules of the verdict have in common: limits and phrases."""

from __future__ import annotations

from processing.quality.figures.stitching import MisreadProbeFigures
from processing.quality.report import Finding, Flag, Verdict


def above(
    value: float | None, flag: Flag, limits: tuple[float, float], sentence: str
) -> list[Finding]:
    """A finding where a figure exceeds the first limit; above the second it asks for a re-fly.

    Args:
        value: the figure; None is not determined.
        flag: of the finding.
        limits: of usable and of re-fly, in the figure's unit.
        sentence: of the finding.

    Returns:
        One finding or none.
    """
    usable, refly = limits
    if value is None or value <= usable:
        return []
    value = float(value)
    if value > refly:
        return [Finding(flag, Verdict.REFLY, f"{sentence} Fly it again.", value, refly)]
    return [Finding(flag, Verdict.USABLE, sentence, value, usable)]


def probe_bias_phrase(figures: MisreadProbeFigures) -> str | None:
    """The probe that may be wrong, and by how much, as part of a sentence.

    Args:
        figures: of one exposure.

    Returns:
        A phrase such as "probe P1 reads 2.0 K too high"; None without such a probe.
    """
    off, probe = figures.misread_k, figures.misread_probe
    if off is None or not probe:
        return None
    return f"probe {probe} reads {abs(off):.1f} K too {'high' if off > 0.0 else 'low'}"
