"""Findings about stitching: tie points, fit, displaced sensors, mountings, scales and slips."""

from __future__ import annotations

import math
from collections.abc import Sequence

from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import EstimatedDcFigures
from processing.quality.figures.image import ContentFigures, IdentityFigures
from processing.quality.figures.stitching import (
    AdjustmentFigures,
    BandFitFigures,
    DisplacedSensorFigures,
    DisplacementFigures,
    DisplacementTestFigures,
    HeadScaleFigures,
    LayerFigures,
    MisreadProbeFigures,
    PlatformFigures,
    PoorestOverlapFigures,
    PrecisionFigures,
    SaturatedOverlapFigures,
    SlipFigures,
    SupportFigures,
    TiePointFigures,
)
from processing.quality.report import Finding, Flag, Thresholds, Verdict
from processing.quality.rules import above, probe_bias_phrase


def stitching_findings(
    figures: QualityFigures, nominal_bands: Sequence[str], thresholds: Thresholds
) -> list[Finding]:
    """Stitching that is weak, does not fit, or disagrees with the calibration.

    Args:
        figures: of one exposure.
        nominal_bands: bands placed by calibration because too few tie points were found.
        thresholds: limits.

    Returns:
        Findings about tie points, fit, scales, mountings, slips and displaced sensors.
    """
    findings = []
    overlap, slip = figures.of(PoorestOverlapFigures), figures.of(SlipFigures)
    elsewhere = figures.of(ContentFigures).mismatched_sensors
    poorest, name = overlap.tie_points_min_overlap, overlap.tie_points_min_overlap_name
    slipped = slip.slip_sensor is not None and slip.slip_sensor in (name or "")
    explained = slipped or bool(elsewhere)
    if poorest is not None and poorest < thresholds.tie_points_per_overlap and not explained:
        where = name or "an overlap"
        total = figures.of(TiePointFigures).tie_points_pp or 0
        too_few = total < thresholds.tie_points_pp_refly
        saturation = figures.of(SaturatedOverlapFigures)
        saturated_fraction = saturation.tie_points_min_overlap_burnt or 0.0
        sentence = (
            f"Few tie points in {where} (water, snow, desert or cloud?): look at the quick look; "
            "fly again if it should have had detail."
        )
        if saturated_fraction > thresholds.saturated_overlap_fraction:
            sentence = (
                f"Few tie points in {where} because it is saturated: {saturated_fraction:.0%} of "
                "the places where points are sought hold saturated pixels. Shorten the exposure."
            )
        findings.append(
            Finding(
                Flag.TIE_POINTS,
                Verdict.REFLY if too_few else Verdict.USABLE,
                sentence,
                float(poorest),
                float(thresholds.tie_points_per_overlap),
            )
        )
    weak = figures.of(SupportFigures).resting_on_calibration
    supported = ", ".join(name for name in weak if name not in elsewhere)
    if supported and not slip.slip_sensor:
        findings.append(
            Finding(
                Flag.TIE_POINTS,
                Verdict.USABLE,
                f"Too little detail to place {supported}: calibration and temperature help to "
                "place them. Look at the quick look; fly again if there should have been detail.",
                figures.of(PrecisionFigures).stitched_sigma_worst_px,
            )
        )
    points = figures.of(BandFitFigures).points_by_band
    findings += [
        Finding(
            Flag.TIE_POINTS,
            Verdict.USABLE,
            f"Too few tie points for {band}: it is placed by calibration; expect colour fringes.",
            _as_float(points.get(band)),
        )
        for band in nominal_bands
    ]
    findings += above(
        figures.of(AdjustmentFigures).sigma0_px,
        Flag.SIGMA0,
        (thresholds.sigma0_px, thresholds.sigma0_refly_px),
        "The sensors do not fit together well; check exposure times and the mount of the heads.",
    )
    findings += _head_scale(figures.of(HeadScaleFigures), thresholds) or _platform(figures)
    findings += _slip(slip, thresholds)
    return findings + _displaced(figures, thresholds)


def _as_float(value: float | None) -> float | None:
    return None if value is None else float(value)


def _displaced(figures: QualityFigures, thresholds: Thresholds) -> list[Finding]:
    """A sensor of the master cone that is not where it was calibrated."""
    findings = []
    displaced = figures.of(DisplacedSensorFigures).displaced_sensor
    displacement = figures.of(DisplacementFigures)
    if displaced or displacement.displaced_several:
        size = math.hypot(
            displacement.displacement_x_px or 0.0, displacement.displacement_y_px or 0.0
        )
        sentence = (
            f"Sensor {displaced} sits {size:.2f} px off its calibrated place; the image is "
            "corrected for it. Go on, and have the camera calibrated."
        )
        alternatives = ", ".join(displacement.displaced_alternatives)
        misread = probe_bias_phrase(figures.of(MisreadProbeFigures))
        if displacement.displaced_several:
            sentence = (
                "More than one sensor of the master cone sits off its calibrated place, and which "
                "ones cannot be determined: the image fits together, but its place in the camera "
                "is uncertain. Go on, and have the camera calibrated."
            )
        elif misread:
            others = f" or {alternatives}" if alternatives else ""
            sentence = (
                f"Either sensor {displaced}{others} sits {size:.2f} px off its calibrated place or "
                f"{misread}; the stitching cannot separate them. The image fits together. Go on, "
                "check the probe after landing, and have the camera calibrated."
            )
        elif alternatives:
            sentence = (
                f"Sensor {displaced} sits {size:.2f} px off its calibrated place, unless it is "
                f"{alternatives}; the image fits together. Go on, and have the camera calibrated."
            )
        test = figures.of(DisplacementTestFigures).displacement_test
        verdict_level = test is None or test > thresholds.displacement_verdict
        verdict = Verdict.USABLE if verdict_level else Verdict.GOOD
        findings.append(Finding(Flag.DISPLACED_SENSOR, verdict, sentence, size))
    return findings


def _platform(figures: QualityFigures) -> list[Finding]:
    """Mountings and layers that are not as the platform calibration has them."""
    platform, layers = figures.of(PlatformFigures), figures.of(LayerFigures)
    test = platform.platform_test
    if test is None or test <= 1.0:
        return []
    causes = ", ".join(layers.platform_causes)
    of_slip = bool(causes) and causes == figures.of(SlipFigures).slip_cone
    if causes and causes in figures.of(IdentityFigures).exchanged_frames:
        return []
    disagreement = figures.of(EstimatedDcFigures).dc_disagreement
    of_temperature = layers.platform_master_changed and disagreement
    if of_slip or of_temperature:
        return []
    moved = platform.platform_shift_px or 0.0
    scale = layers.common_scale_ppm or 0.0
    other = ", ".join(platform.platform_alternatives)
    others = f", or {other}," if other else ""
    sentence = (
        f"Head {platform.platform_shift_head}{others} sits {moved:.2f} px off the platform "
        "calibration; the image is corrected for it. Go on, and calibrate the platform from this "
        "flight."
    )
    if layers.platform_master_changed:
        sentence = (
            f"The layers of the other cones do not fit the master cone (common scale {scale:+.0f} "
            f"ppm; cause: cone {causes}"
            + (f", or {other}" if other else "")
            + "): its principal distance or mounting has changed, or the rig file is of another "
            "camera. The whole image may be shifted or scaled; its stated accuracy includes "
            "this. Check the serial numbers, and process again with the right calibration."
        )
    elif causes:
        sentence = (
            f"Cone {causes} differs from the platform calibration in scale or rotation (by up to "
            f"{moved:.2f} px); the image is corrected for it. Check that the rig file belongs to "
            "this camera, and calibrate the platform from this flight."
        )
    return [Finding(Flag.CALIBRATION_EXPIRED, Verdict.USABLE, sentence, test, 1.0)]


def _head_scale(scale: HeadScaleFigures, thresholds: Thresholds) -> list[Finding]:
    """A converging head whose scale does not fit: rotations cannot correct that."""
    scale_ppm = scale.platform_scale_ppm
    if scale_ppm is None or abs(scale_ppm) <= thresholds.head_scale_ppm:
        return []
    return [
        Finding(
            Flag.CALIBRATION_EXPIRED,
            Verdict.USABLE,
            f"The scale of head {scale.platform_scale_head} differs by {scale_ppm:+.0f} "
            "ppm from its neighbours': its principal distance is not as calibrated. The image is "
            "not corrected for it; its stated accuracy includes it. Check the serial numbers, and "
            "calibrate the head.",
            scale_ppm,
            thresholds.head_scale_ppm,
        )
    ]


def _slip(slip: SlipFigures, thresholds: Thresholds) -> list[Finding]:
    """A band of a frame that was read out shifted."""
    shift_px = slip.slip_px
    if shift_px is None:
        return []
    others = slip.slip_sensors[1:]
    also = f" Also shifted: {', '.join(dict.fromkeys(others))}." if others else ""
    alternatives = ", ".join(slip.slip_alternatives)
    instead = f" (or {alternatives}, which sees the same ground)" if alternatives else ""
    verdict_level = shift_px >= thresholds.slip_refly_px
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY if verdict_level else Verdict.USABLE,
            f"In the frame of {slip.slip_sensor}{instead}, {slip.slip_axis} "
            f"{slip.slip_first} to {slip.slip_last} lie {shift_px:.1f} px off "
            f"the rest: lines were lost or repeated in read-out.{also} Check the head and its "
            "cable." + (" Fly this exposure again." if verdict_level else ""),
            shift_px,
            thresholds.slip_refly_px,
        )
    ]
