"""Requirements of a project on every exposure, and findings where they are not met.

A specification is a contract: what breaks it has to be flown again, however well it looks. Limits
that hold for any project are in `processing.quality.report.Thresholds`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import GeometryFigures, TimeFigures
from processing.quality.report import Finding, Flag, Verdict


@dataclass(frozen=True)
class QualityRequirements:
    """The limits of a project; None where it asks for nothing.

    Overlaps are shares of the image, as least values; `sun_deg` is the least elevation of the sun;
    the others are the most that is taken.
    """

    forward_overlap: float | None = None
    sidelap: float | None = None
    gsd_m: float | None = None
    tilt_deg: float | None = None
    crab_deg: float | None = None
    sun_deg: float | None = None
    time_sigma_ns: float | None = None


def requirement_findings(
    figures: QualityFigures, requirements: QualityRequirements
) -> Iterator[Finding]:
    """What a project asks for and an exposure does not keep.

    Unknown figures are not evaluated.

    Args:
        figures: of one exposure.
        requirements: limits of the project.

    Yields:
        A finding with a re-fly for each requirement that is not met.
    """
    geometry, time = figures.of(GeometryFigures), figures.of(TimeFigures)
    for value, limit, flag, is_minimum, sentence in (
        (
            *(geometry.forward_overlap, requirements.forward_overlap, Flag.OVERLAP, True),
            "Only {value:.0%} forward overlap, {limit:.0%} asked for; fly this part of the line "
            "again.",
        ),
        (
            *(geometry.sidelap, requirements.sidelap, Flag.OVERLAP, True),
            "Only {value:.0%} sidelap with the neighbouring line, {limit:.0%} asked for; fly this "
            "part of the line again, nearer to it.",
        ),
        (
            *(geometry.gsd_m, requirements.gsd_m, Flag.GSD, False),
            "The GSD is {value:.3f} m, {limit:.3f} m asked for; fly lower, and this part again.",
        ),
        (
            *(geometry.tilt_deg, requirements.tilt_deg, Flag.TILT, False),
            "Tilted by {value:.1f} deg, {limit:.1f} deg allowed; fly this part again, level.",
        ),
        (
            *(geometry.crab_deg, requirements.crab_deg, Flag.DRIFT, False),
            "Turned by {value:.1f} deg against the track, {limit:.1f} deg allowed; set the drift "
            "angle of the mount and fly this part again.",
        ),
        (
            *(geometry.sun_deg, requirements.sun_deg, Flag.SUN, True),
            "The sun is {value:.1f} deg high, {limit:.1f} deg asked for; fly this part again "
            "when it is higher.",
        ),
        (
            *(time.time_sigma_ns, requirements.time_sigma_ns, Flag.TIME_SIGMA, False),
            "The time is known to {value:.0f} ns, {limit:.0f} ns asked for; check strobe cable and "
            "receiver, and fly this part again.",
        ),
    ):
        if limit is None or value is None:
            continue
        if value < limit if is_minimum else value > limit:
            value_text = sentence.format(value=value, limit=limit)
            yield Finding(flag, Verdict.REFLY, value_text, float(value), limit)
