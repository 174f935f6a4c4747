"""From figures to findings and a verdict: every rule by which a flag is raised, and its sentence.

Rules about what a frame shows are in `processing.quality.content_findings`, those about its
pixels in `processing.quality.image_findings`, those about stitching in
`processing.quality.stitching_findings`.
What a report consists of, the thresholds and the meaning of every figure are in
`processing.quality.report`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from processing.quality.content_findings import (
    content_findings,
    dark_frame_findings,
    identity_findings,
    other_ground_findings,
    word_format_findings,
)
from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import (
    EstimatedDcFigures,
    GeometryFigures,
    TimeFigures,
)
from processing.quality.figures.image import (
    ContentFigures,
    UnreadFigures,
    ValidAreaFigures,
    ValidFigures,
)
from processing.quality.figures.stitching import DisplacedSensorFigures, MisreadProbeFigures
from processing.quality.image_findings import exposure_findings, signal_findings
from processing.quality.report import (
    NO_FLAGS,
    Finding,
    Flag,
    QualityReport,
    Thresholds,
    Verdict,
)
from processing.quality.requirements import QualityRequirements, requirement_findings
from processing.quality.rules import above, probe_bias_phrase
from processing.quality.stitching_findings import stitching_findings

_CAPTURE: Final[Mapping[Flag, tuple[Verdict, str]]] = {
    Flag.FRAME_LATE: (
        Verdict.GOOD,
        "A frame came late; if it happens again, check the load of the camera network.",
    ),
    Flag.FRAME_DUPLICATE: (
        Verdict.GOOD,
        "A frame came twice; the first was kept. Check that one computer alone owns the head.",
    ),
    Flag.FRAME_CORRUPT: (
        Verdict.USABLE,
        "A frame was damaged and left out; check cable and network settings of that head.",
    ),
    Flag.FRAME_AMBIGUOUS: (
        Verdict.USABLE,
        "A frame came that may be the missing one or another exposure's, and was left out; check "
        "cable and network settings of that head.",
    ),
    Flag.MARK_MISSING: (
        Verdict.USABLE,
        "The receiver gave no event mark, the time is interpolated; check the strobe cable.",
    ),
    Flag.MARK_AMBIGUOUS: (
        Verdict.USABLE,
        "Two event marks could belong to this exposure; check the strobe line for noise.",
    ),
    Flag.TIME_HOLDOVER: (
        Verdict.USABLE,
        "The clock coasts without marks or pulse per second; check the cables of the receiver.",
    ),
    Flag.PTP_FAULT: (
        Verdict.GOOD,
        "The clock of a head lost its PTP master, or contradicts the receiver; check the "
        "grandmaster.",
    ),
    Flag.DC_DISAGREEMENT: (
        Verdict.USABLE,
        "Probes and stitching disagree on the temperature; check the probes after landing.",
    ),
    Flag.CALIBRATION_EXPIRED: (
        Verdict.USABLE,
        "The calibration has expired; go on, and have the camera calibrated.",
    ),
    Flag.UNCALIBRATED: (
        Verdict.USABLE,
        "The rig is uncalibrated: places in the image are nominal; calibrate the camera with this "
        "flight, then process it again.",
    ),
    Flag.OVERLAP: (
        Verdict.REFLY,
        "The overlap is below plan; fly this part of the line again.",
    ),
    Flag.SUN: (
        Verdict.USABLE,
        "The sun is low: long shadows; go on when it is higher if the project asks for it.",
    ),
    Flag.GSD: (
        Verdict.USABLE,
        "The ground sampling distance is coarser than planned; fly lower.",
    ),
    Flag.GNSS: (
        Verdict.USABLE,
        "GNSS quality is poor; wait for a better fix before the next line if the plan allows.",
    ),
    Flag.DISK_LOW: (
        Verdict.GOOD,
        "The disk is nearly full; finish this line and change the disk.",
    ),
    Flag.NOT_MIRRORED: (
        Verdict.GOOD,
        "This exposure is stored on one disk only; see which disk was dropped, and why.",
    ),
    Flag.PROCESSING_BEHIND: (
        Verdict.GOOD,
        "Processing is behind capture; raw frames are safe and will be processed later.",
    ),
    Flag.SIMULATED: (Verdict.GOOD, "Simulated hardware: not a survey."),
    Flag.NOT_PROCESSED: (
        Verdict.USABLE,
        "This exposure was not processed; its raw frames are safe: process it on the ground.",
    ),
}


def evaluate(
    figures: QualityFigures,
    *,
    capture_flags: Flag = NO_FLAGS,
    missing_sensors: Sequence[str] = (),
    missing_probes: Sequence[str] = (),
    probes_out_of_range: Sequence[str] = (),
    nominal_bands: Sequence[str] = (),
    mismatched_bands: Sequence[str] = (),
    thresholds: Thresholds | None = None,
    requirements: QualityRequirements | None = None,
) -> QualityReport:
    """Findings and verdict of one exposure from its figures.

    A figure that is not determined raises nothing: what is not known is not evaluated.

    Args:
        figures: of all steps that looked for any.
        capture_flags: what capture already knows (late frame, event mark missing, ...).
        missing_sensors: sensors whose frame is not there.
        missing_probes: probes that gave no temperature.
        probes_out_of_range: probes whose temperature cannot be.
        nominal_bands: colours placed by calibration because too few tie points were found.
        mismatched_bands: those of them that have texture that does not match that of green.
        thresholds: None takes the defaults.
        requirements: of the project, if any.

    Returns:
        The report, its verdict that of the gravest finding.

    Source: docs/explanation/mathematics/quality.md#flags-and-verdict.
    """
    limits, figures = thresholds or Thresholds(), figures.finite()
    findings = [
        Finding(flag, *_CAPTURE[flag]) for flag in Flag if flag & capture_flags and flag in _CAPTURE
    ]
    findings += _frames(figures, capture_flags, missing_sensors, limits)
    findings += _time_and_temperature(figures, missing_probes, probes_out_of_range, limits)
    findings += dark_frame_findings(figures)
    findings += content_findings(figures, mismatched_bands)
    findings += other_ground_findings(figures)
    findings += stitching_findings(
        figures, [b for b in nominal_bands if b not in mismatched_bands], limits
    )
    findings += word_format_findings(figures) + identity_findings(figures)
    findings += (
        [] if figures.of(ContentFigures).mismatched_sensors else signal_findings(figures, limits)
    )
    findings += exposure_findings(figures, limits)
    findings += _attitude(figures.of(GeometryFigures), limits)
    broken = list(requirement_findings(figures, requirements or QualityRequirements()))
    findings = [f for f in findings if f.flag not in {b.flag for b in broken}] + broken
    order = list(Verdict)
    worst = max((order.index(finding.verdict) for finding in findings), default=0)
    flags = capture_flags
    for finding in findings:
        flags |= finding.flag
    return QualityReport(order[worst], flags, tuple(findings), figures)


def _frames(
    figures: QualityFigures,
    capture_flags: Flag,
    missing_sensors: Sequence[str],
    thresholds: Thresholds,
) -> list[Finding]:
    findings, gap = [], _gap(figures.of(ValidAreaFigures))
    if missing_sensors or capture_flags & Flag.FRAME_MISSING:
        heads = f"Head{'s' * (len(missing_sensors) > 1)} {', '.join(missing_sensors)}"
        findings.append(
            Finding(
                Flag.FRAME_MISSING,
                Verdict.USABLE,
                f"{heads if missing_sensors else 'A head'} sent no image{gap}. Check "
                "power and cable.",
                float(len(missing_sensors)) or None,
                0.0,
            )
        )
    worst = figures.of(UnreadFigures)
    unread = worst.unread_worst_fraction
    if unread is not None and unread > thresholds.unread_fraction:
        findings.append(
            Finding(
                Flag.FRAME_CORRUPT,
                Verdict.USABLE,
                f"{unread:.0%} of {worst.unread_worst_sensor} was not read out: it is "
                f"below black{gap}. Check head and cable.",
                unread,
                thresholds.unread_fraction,
            )
        )
    valid = figures.of(ValidFigures).valid_fraction
    if valid is not None and valid < thresholds.valid_refly_fraction:
        findings.append(
            Finding(
                Flag.FRAME_MISSING,
                Verdict.REFLY,
                f"Only {valid:.0%} of the image holds data; fly this exposure again.",
                valid,
                thresholds.valid_refly_fraction,
            )
        )
    return findings


def _gap(area: ValidAreaFigures) -> str:
    """What of the image is missing, as the end of a sentence; coverage counts it."""
    valid, band = area.valid_worst_fraction, area.valid_worst_band
    if valid is None or not band:
        return ""
    return f"; {1.0 - valid:.0%} of {band} has no valid pixels, which coverage counts as a gap"


def _time_and_temperature(
    figures: QualityFigures,
    missing_probes: Sequence[str],
    probes_out_of_range: Sequence[str],
    thresholds: Thresholds,
) -> list[Finding]:
    time = figures.of(TimeFigures)
    findings = above(
        time.time_sigma_ns,
        Flag.TIME_SIGMA,
        (thresholds.time_sigma_ns, thresholds.time_sigma_refly_ns),
        "The exposure's time is uncertain; check strobe cable and receiver.",
    )
    findings += above(
        time.time_error_px,
        Flag.TIME_SIGMA,
        (thresholds.time_error_px, thresholds.time_error_refly_px),
        "The exposure's time is too uncertain for this speed and GSD; see the time budget: "
        "check strobe cable and receiver.",
    )
    if missing_probes:
        findings.append(
            Finding(
                Flag.TEMPERATURE_MISSING,
                Verdict.USABLE,
                f"No temperature of probe {', '.join(missing_probes)}: the other probes stand in, "
                "calibration where there are none; check the probe.",
                float(len(missing_probes)),
                0.0,
            )
        )
    findings += above(
        figures.of(GeometryFigures).temperature_age_s,
        Flag.TEMPERATURE_STALE,
        (thresholds.temperature_age_s, math.inf),
        "Temperatures are old; check the probe module and its line.",
    )
    findings += _temperature_by_stitching(figures)
    if probes_out_of_range:
        findings.append(
            Finding(
                Flag.TEMPERATURE_RANGE,
                Verdict.USABLE,
                f"Probe {', '.join(probes_out_of_range)} is outside "
                f"{thresholds.temperature_low_c:g} to {thresholds.temperature_high_c:g} degC "
                "and was not used; check the probe.",
                float(len(probes_out_of_range)),
                0.0,
            )
        )
    return findings


def _temperature_by_stitching(figures: QualityFigures) -> list[Finding]:
    estimated = figures.of(EstimatedDcFigures)
    disagreeing = estimated.dc_disagreement
    misread = probe_bias_phrase(figures.of(MisreadProbeFigures))
    displaced = figures.of(DisplacedSensorFigures).displaced_sensor
    if not (disagreeing or misread):
        return []
    where = f" of cone {', '.join(disagreeing)}" if disagreeing else ""
    why = "a stuck probe, a moved sensor or an old calibration"
    if misread and displaced:
        why = f"{misread}, or sensor {displaced} has moved"
    elif misread:
        why = f"{misread}, which explains where the sensors are better than a moved sensor"
    sentence = (
        f"Probe and stitching disagree on the temperature{where}: {why}; check the probe after "
        "landing."
    )
    value = estimated.dc_estimated_k
    return [Finding(Flag.DC_DISAGREEMENT, Verdict.USABLE, sentence, value)]


def _attitude(figures: GeometryFigures, thresholds: Thresholds) -> list[Finding]:
    return above(
        figures.tilt_deg,
        Flag.TILT,
        (math.degrees(thresholds.tilt_rad), math.inf),
        "The camera was tilted; check the mount and fly the line level.",
    ) + above(
        figures.crab_deg,
        Flag.DRIFT,
        (math.degrees(thresholds.crab_rad), math.inf),
        "The camera does not point along the track; set the drift angle of the mount.",
    )
