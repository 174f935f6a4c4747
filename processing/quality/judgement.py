"""From figures to findings and a verdict: every rule by which a flag is raised, and its sentence.

What a report consists of, the thresholds and the meaning of every figure are in
`processing.quality.report`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from processing.quality.report import (
    NO_FLAGS,
    Figure,
    Finding,
    Flag,
    QualityReport,
    Thresholds,
    Verdict,
    finite,
)
from processing.quality.specification import Asked, asked_findings

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
    Flag.DC_DISAGREEMENT: (
        Verdict.USABLE,
        "Probes and stitching disagree on the temperature; check the probes after landing.",
    ),
    Flag.CALIBRATION_EXPIRED: (
        Verdict.USABLE,
        "The calibration has expired; go on, and have the camera calibrated.",
    ),
    Flag.OVERLAP: (
        Verdict.REFLY,
        "The overlap is below plan; fly this part of the line again.",
    ),
    Flag.SUN: (
        Verdict.USABLE,
        "The sun stands low: long shadows; go on when it is higher if the project asks for it.",
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


def judge(
    figures: Mapping[str, Figure],
    *,
    capture_flags: Flag = NO_FLAGS,
    missing_sensors: Sequence[str] = (),
    missing_probes: Sequence[str] = (),
    probes_out_of_range: Sequence[str] = (),
    nominal_bands: Sequence[str] = (),
    mismatched_bands: Sequence[str] = (),
    thresholds: Thresholds | None = None,
    asked: Asked | None = None,
) -> QualityReport:
    """Findings and verdict of one exposure from its figures.

    A figure that is missing or None raises nothing: what is not known is not judged.

    Args:
        figures: by documented name.
        capture_flags: what capture already knows (late frame, event mark missing, ...).
        missing_sensors: sensors whose frame is not there.
        missing_probes: probes that gave no temperature.
        probes_out_of_range: probes whose temperature cannot be.
        nominal_bands: colours placed by calibration because too few tie points were found.
        mismatched_bands: those of them that have texture that does not match that of green.
        asked: what the project asks for, where it does.
    """
    t = thresholds or Thresholds()
    findings = [
        Finding(flag, *_CAPTURE[flag]) for flag in Flag if flag & capture_flags and flag in _CAPTURE
    ]
    findings += _frames(figures, capture_flags, missing_sensors, t)
    findings += _time_and_temperature(figures, missing_probes, probes_out_of_range, t)
    findings += _content(figures, mismatched_bands)
    findings += _stitching(figures, [b for b in nominal_bands if b not in mismatched_bands], t)
    findings += _words(figures)
    findings += [] if figures.get("mismatched_sensors") else _signal(figures, t)
    findings += _exposure(figures, t)
    findings += _attitude(figures, t)
    broken = list(asked_findings(figures, asked or Asked()))
    findings = [f for f in findings if f.flag not in {b.flag for b in broken}] + broken
    order = list(Verdict)
    worst = max((order.index(finding.verdict) for finding in findings), default=0)
    flags = capture_flags
    for finding in findings:
        flags |= finding.flag
    return QualityReport(order[worst], flags, tuple(findings), finite(figures))


def _frames(
    figures: Mapping[str, Figure],
    capture_flags: Flag,
    missing_sensors: Sequence[str],
    t: Thresholds,
) -> list[Finding]:
    findings = []
    if missing_sensors or capture_flags & Flag.FRAME_MISSING:
        heads = f"Head{'s' * (len(missing_sensors) > 1)} {', '.join(missing_sensors)}"
        findings.append(
            Finding(
                Flag.FRAME_MISSING,
                Verdict.USABLE,
                f"{heads if missing_sensors else 'A head'} sent no image{_gap(figures)}. Check "
                "power and cable.",
                float(len(missing_sensors)) or None,
                0.0,
            )
        )
    unread = _number(figures, "unread_worst_fraction")
    if unread is not None and unread > t.unread_fraction:
        findings.append(
            Finding(
                Flag.FRAME_CORRUPT,
                Verdict.USABLE,
                f"{unread:.0%} of {figures.get('unread_worst_sensor')} was not read out: it is "
                f"below black{_gap(figures)}. Check head and cable.",
                unread,
                t.unread_fraction,
            )
        )
    valid = _number(figures, "valid_fraction")
    if valid is not None and valid < t.valid_refly_fraction:
        findings.append(
            Finding(
                Flag.FRAME_MISSING,
                Verdict.REFLY,
                f"Only {valid:.0%} of the image holds data; fly this exposure again.",
                valid,
                t.valid_refly_fraction,
            )
        )
    return findings


def _gap(figures: Mapping[str, Figure]) -> str:
    """What of the image is missing, as the end of a sentence; coverage counts it."""
    valid, band = _number(figures, "valid_worst_fraction"), figures.get("valid_worst_band")
    if valid is None or not band:
        return ""
    return f"; {1.0 - valid:.0%} of {band} has no valid pixels, which coverage counts as a gap"


def _time_and_temperature(
    figures: Mapping[str, Figure],
    missing_probes: Sequence[str],
    probes_out_of_range: Sequence[str],
    t: Thresholds,
) -> list[Finding]:
    findings = _above(
        figures,
        "time_sigma_ns",
        Flag.TIME_SIGMA,
        (t.time_sigma_ns, t.time_sigma_refly_ns),
        "The exposure's time is uncertain; check strobe cable and receiver.",
    )
    findings += _above(
        figures,
        "time_error_px",
        Flag.TIME_SIGMA,
        (t.time_error_px, t.time_error_refly_px),
        "The exposure's time is too uncertain for this speed and GSD; the budget says by what: "
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
    findings += _above(
        figures,
        "temperature_age_s",
        Flag.TEMPERATURE_STALE,
        (t.temperature_age_s, math.inf),
        "Temperatures are old; check the probe module and its line.",
    )
    findings += _temperature_by_stitching(figures)
    if probes_out_of_range:
        findings.append(
            Finding(
                Flag.TEMPERATURE_RANGE,
                Verdict.USABLE,
                f"Probe {', '.join(probes_out_of_range)} is outside {t.temperature_low_c:g} to "
                f"{t.temperature_high_c:g} degC and was not used; check the probe.",
                float(len(probes_out_of_range)),
                0.0,
            )
        )
    return findings


def _temperature_by_stitching(figures: Mapping[str, Figure]) -> list[Finding]:
    disagreeing = figures.get("dc_disagreement")
    misread, displaced = _misreading(figures), figures.get("displaced_sensor")
    if not (disagreeing or misread):
        return []
    where = f" of cone {disagreeing}" if disagreeing else ""
    why = "a stuck probe, a moved sensor or an old calibration"
    if misread and displaced:
        why = f"{misread}, or sensor {displaced} has moved"
    elif misread:
        why = f"{misread}, which explains where the sensors are better than a moved sensor"
    sentence = (
        f"Probe and stitching disagree on the temperature{where}: {why}; check the probe after "
        "landing."
    )
    value = _number(figures, "dc_estimated_k")
    return [Finding(Flag.DC_DISAGREEMENT, Verdict.USABLE, sentence, value)]


def _misreading(figures: Mapping[str, Figure]) -> str | None:
    """The probe that may be wrong, and by how much, as part of a sentence."""
    off, probe = _number(figures, "misread_k"), figures.get("misread_probe")
    if off is None or not probe:
        return None
    return f"probe {probe} reads {abs(off):.1f} K too {'high' if off > 0.0 else 'low'}"


def _stitching(
    figures: Mapping[str, Figure], nominal_bands: Sequence[str], t: Thresholds
) -> list[Finding]:
    findings = []
    poorest = _number(figures, "tie_points_min_overlap")
    slipped = str(figures.get("slip_sensor") or "none") in str(
        figures.get("tie_points_min_overlap_name")
    )
    explained = slipped or bool(figures.get("mismatched_sensors"))
    if poorest is not None and poorest < t.tie_points_per_overlap and not explained:
        where = figures.get("tie_points_min_overlap_name") or "an overlap"
        total = _number(figures, "tie_points_pp") or 0.0
        too_few = total < t.tie_points_pp_refly
        burnt = _number(figures, "tie_points_min_overlap_burnt") or 0.0
        sentence = (
            f"Few tie points in {where} (water, snow, desert or cloud?): look at the quick look; "
            "fly again if it should have had detail."
        )
        if burnt > t.burnt_overlap_fraction:
            sentence = (
                f"Few tie points in {where} because it is burnt out: {burnt:.0%} of the places "
                "where points are sought hold saturated pixels. Shorten the exposure."
            )
        findings.append(
            Finding(
                Flag.TIE_POINTS,
                Verdict.REFLY if too_few else Verdict.USABLE,
                sentence,
                poorest,
                float(t.tie_points_per_overlap),
            )
        )
    elsewhere = str(figures.get("mismatched_sensors") or "").split(", ")
    weak = str(figures.get("resting_on_calibration") or "").split(", ")
    resting = ", ".join(name for name in weak if name and name not in elsewhere)
    if resting and not figures.get("slip_sensor"):
        findings.append(
            Finding(
                Flag.TIE_POINTS,
                Verdict.USABLE,
                f"Too little detail to place {resting}: calibration and temperature help to place "
                "them. Look at the quick look; fly again if there should have been detail.",
                _number(figures, "stitched_sigma_worst_px"),
            )
        )
    findings += [
        Finding(
            Flag.TIE_POINTS,
            Verdict.USABLE,
            f"Too few tie points for {band}: it is placed by calibration; expect colour fringes.",
            _number(figures, f"{band}_points"),
        )
        for band in nominal_bands
    ]
    findings += _above(
        figures,
        "sigma0_px",
        Flag.SIGMA0,
        (t.sigma0_px, t.sigma0_refly_px),
        "The sensors do not fit together well; check exposure times and the mount of the heads.",
    )
    findings += _head_scale(figures, t) or _platform(figures)
    findings += _slip(figures, t)
    displaced = figures.get("displaced_sensor")
    if displaced or figures.get("displaced_several"):
        size = math.hypot(
            _number(figures, "displacement_x_px") or 0.0,
            _number(figures, "displacement_y_px") or 0.0,
        )
        sentence = (
            f"Sensor {displaced} sits {size:.2f} px off its calibrated place; the image is "
            "corrected for it. Go on, and have the camera calibrated."
        )
        alternatives, misread = figures.get("displaced_alternatives"), _misreading(figures)
        if figures.get("displaced_several"):
            sentence = (
                "More than one sensor of the master cone sits off its calibrated place, and which "
                "ones cannot be told: the image fits together, but its place in the camera is "
                "uncertain. Go on, and have the camera calibrated."
            )
        elif misread:
            others = f" or {alternatives}" if alternatives else ""
            sentence = (
                f"Either sensor {displaced}{others} sits {size:.2f} px off its calibrated place or "
                f"{misread}; the stitching cannot tell, and the image fits together. Go on, check "
                "the probe after landing, and have the camera calibrated."
            )
        elif alternatives:
            sentence = (
                f"Sensor {displaced} sits {size:.2f} px off its calibrated place, unless it is "
                f"{alternatives}; the image fits together. Go on, and have the camera calibrated."
            )
        test = _number(figures, "displacement_test")
        grave = test is None or test > t.displacement_verdict
        verdict = Verdict.USABLE if grave else Verdict.GOOD
        findings.append(Finding(Flag.DISPLACED_SENSOR, verdict, sentence, size))
    return findings


def _platform(figures: Mapping[str, Figure]) -> list[Finding]:
    """Mountings and layers that are not as the platform calibration has them."""
    test = _number(figures, "platform_test")
    if test is None or test <= 1.0:
        return []
    causes = figures.get("platform_causes")
    of_slip = causes is not None and causes == figures.get("slip_cone")
    of_temperature = figures.get("platform_master_changed") and figures.get("dc_disagreement")
    if of_slip or of_temperature:
        return []
    moved = _number(figures, "platform_shift_px") or 0.0
    scale = _number(figures, "common_scale_ppm") or 0.0
    other = figures.get("platform_alternatives")
    others = f", or {other}," if other else ""
    sentence = (
        f"Head {figures.get('platform_shift_head')}{others} sits {moved:.2f} px off the platform "
        "calibration; the image is corrected for it. Go on, and calibrate the platform from this "
        "flight."
    )
    if figures.get("platform_master_changed"):
        sentence = (
            f"The layers of the other cones do not fit the master cone (common scale {scale:+.0f} "
            f"ppm; cause: cone {causes}"
            + (f", or {other}" if other else "")
            + "): its principal distance or mounting has changed, or the rig file is of another "
            "camera. The whole image may be shifted or scaled; its stated accuracy says by how "
            "much. Check the serial numbers, and process again with the right calibration."
        )
    elif causes:
        sentence = (
            f"Cone {causes} differs from the platform calibration in scale or rotation (by up to "
            f"{moved:.2f} px); the image is corrected for it. Check that the rig file belongs to "
            "this camera, and calibrate the platform from this flight."
        )
    return [Finding(Flag.CALIBRATION_EXPIRED, Verdict.USABLE, sentence, test, 1.0)]


def _head_scale(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    """A converging head whose scale does not fit: rotations cannot correct that."""
    scale_ppm = _number(figures, "platform_scale_ppm")
    if scale_ppm is None or abs(scale_ppm) <= t.head_scale_ppm:
        return []
    return [
        Finding(
            Flag.CALIBRATION_EXPIRED,
            Verdict.USABLE,
            f"The scale of head {figures.get('platform_scale_head')} differs by {scale_ppm:+.0f} "
            "ppm from its neighbours': its principal distance is not as calibrated. The image is "
            "not corrected for it; its stated accuracy includes it. Check the serial numbers, and "
            "calibrate the head.",
            scale_ppm,
            t.head_scale_ppm,
        )
    ]


def _content(figures: Mapping[str, Figure], bands: Sequence[str]) -> list[Finding]:
    """Frames with texture that show other ground than their neighbours."""
    misread = str(figures.get("word_format_sensors") or "").split(", ")
    frames = str(figures.get("mismatched_sensors") or "").split(", ")
    named = ", ".join([*(f for f in frames if f and f not in misread), *bands])
    if not named:
        return []
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY,
            f"The frame of {named} shows other ground than its neighbours although it has texture: "
            "frames swapped, of another exposure, turned or mirrored, or the head has moved. "
            "Check cables and serial numbers of the heads. Fly this exposure again.",
            _number(figures, "mismatched_positions"),
        )
    ]


def _slip(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    """A band of a frame that was read out shifted."""
    shift_px = _number(figures, "slip_px")
    if shift_px is None:
        return []
    others = str(figures.get("slip_sensors") or "").split(", ")[1:]
    also = f" Also shifted: {', '.join(dict.fromkeys(others))}." if others else ""
    alternatives = figures.get("slip_alternatives")
    instead = f" (or {alternatives}, which sees the same ground)" if alternatives else ""
    grave = shift_px >= t.slip_refly_px
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY if grave else Verdict.USABLE,
            f"In the frame of {figures.get('slip_sensor')}{instead}, {figures.get('slip_axis')} "
            f"{figures.get('slip_first')} to {figures.get('slip_last')} lie {shift_px:.1f} px off "
            f"the rest: lines were lost or repeated in read-out.{also} Check the head and its "
            "cable." + (" Fly this exposure again." if grave else ""),
            shift_px,
            t.slip_refly_px,
        )
    ]


def _words(figures: Mapping[str, Figure]) -> list[Finding]:
    """Words that have another format than the rig file says."""
    words = figures.get("word_format")
    if not words:
        return []
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY,
            f"The words of {figures.get('word_format_sensors')} are {words}, not as the rig "
            "file says: set the pixel format of the head, or `bits` and `justified` in the rig "
            "file. The pixels stored are good; process them again with the right rig file.",
        )
    ]


def _signal(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    """Signal that a head or its read-out has changed."""
    findings = []
    step = _number(figures, "signal_step")
    # Lines that were not read out are a step, too.
    unread = _number(figures, "unread_worst_fraction") or 0.0
    unread_sensor = figures.get("unread_worst_sensor") if unread > t.unread_fraction else None
    if step is not None and figures.get("signal_step_sensor") != unread_sensor:
        lines = _number(figures, "signal_step_lines") or 1.0
        where = f"{figures.get('signal_step_axis')} of {figures.get('signal_step_sensor')}"
        sentence = (
            f"The signal changes by {step:+.0%} after line {figures.get('signal_step_at')} of the "
            f"{where}: gain or offset changed during read-out. Radiometry of this frame is wrong. "
            "Check the head."
        )
        if lines > 2.0:
            sentence = (
                f"The {where} show banding of {abs(step):.0%} in {lines:.0f} lines: check power "
                "supply and cable of the head. Radiometry of this frame is wrong."
            )
        findings.append(Finding(Flag.FRAME_CORRUPT, Verdict.USABLE, sentence, step))
    outlier, signal = figures.get("gain_outlier"), _number(figures, "gain_outlier_signal")
    if outlier and signal is not None:
        findings.append(
            Finding(
                Flag.UNDEREXPOSED if signal < 1.0 else Flag.OVEREXPOSED,
                Verdict.USABLE,
                f"Head {outlier} shows {signal:.2f} times the signal of the others in the "
                "overlaps: its exposure time, aperture or gain is not what the record says. The "
                "image is balanced to the other heads; its noise differs there. Check the head's "
                "settings.",
                signal,
                1.0,
            )
        )
    blurred, ratio = figures.get("blurred_sensor"), _number(figures, "blurred_ratio")
    if blurred and ratio is not None:
        findings.append(
            Finding(
                Flag.BLUR,
                Verdict.USABLE,
                f"Head {blurred} shows {ratio:.0%} of its neighbours' fine detail on the same "
                "ground: out of focus, dew or smear. Check its lens.",
                ratio,
            )
        )
    return findings


def _exposure(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    findings = []
    bright = _number(figures, "bright_fraction")
    if bright is not None and bright < t.bright_fraction:
        black = bright < t.bright_refly_fraction
        findings.append(
            Finding(
                Flag.UNDEREXPOSED,
                Verdict.REFLY if black else Verdict.USABLE,
                "The image is black; check shutter, aperture and lens cover. Fly it again."
                if black
                else "The image is dark; lengthen the exposure or open the aperture.",
                bright,
                t.bright_refly_fraction if black else t.bright_fraction,
            )
        )
    findings += _above(
        figures,
        "saturated_fraction",
        Flag.OVEREXPOSED,
        (t.saturated_fraction, t.saturated_refly_fraction),
        "Parts of the image are burnt out; shorten the exposure.",
    )
    for name, way in (("smear_along_px", "along"), ("smear_across_px", "across")):
        findings += _above(
            figures,
            name,
            Flag.BLUR,
            (t.smear_px, t.smear_refly_px),
            f"Motion blur {way} track; shorten the exposure, check TDI, speed, mount and crab.",
        )
    sharpness = _number(figures, "sharpness")
    if sharpness is not None and sharpness < t.sharpness:
        findings.append(
            Finding(
                Flag.BLUR,
                Verdict.USABLE,
                "The image holds no fine detail; look at the quick look for cloud, dew or blur.",
                sharpness,
                t.sharpness,
            )
        )
    return findings


def _attitude(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    return _above(
        figures,
        "tilt_deg",
        Flag.TILT,
        (math.degrees(t.tilt_rad), math.inf),
        "The camera was tilted; check the mount and fly the line level.",
    ) + _above(
        figures,
        "crab_deg",
        Flag.DRIFT,
        (math.degrees(t.crab_rad), math.inf),
        "The camera does not point along the track; set the drift angle of the mount.",
    )


def _above(
    figures: Mapping[str, Figure],
    name: str,
    flag: Flag,
    limits: tuple[float, float],
    sentence: str,
) -> list[Finding]:
    """A finding where a figure exceeds the first limit; above the second it asks for a re-fly."""
    value = _number(figures, name)
    usable, refly = limits
    if value is None or value <= usable:
        return []
    if value > refly:
        return [Finding(flag, Verdict.REFLY, f"{sentence} Fly it again.", value, refly)]
    return [Finding(flag, Verdict.USABLE, sentence, value, usable)]


def _number(figures: Mapping[str, Figure], name: str) -> float | None:
    value = figures.get(name)
    if value is None or isinstance(value, str) or not math.isfinite(value):
        return None
    return float(value)
