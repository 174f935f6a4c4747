"""Findings about the pixels of an exposure: signal, exposure and sharpness."""

from __future__ import annotations

from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import (
    ExposureScaleFigures,
    ImplausibleExposureFigures,
    SmearFigures,
    UnknownExposureFigures,
)
from processing.quality.figures.image import (
    BalanceFigures,
    BlockFigures,
    ClippingFigures,
    DefectLineFigures,
    LocalBlurFigures,
    RelativeSharpnessFigures,
    RepeatedLineFigures,
    ResponseFigures,
    SaturationFigures,
    SharpnessFigures,
    SignalFigures,
    SignalStepFigures,
    UnreadFigures,
)
from processing.quality.report import Finding, Flag, Thresholds, Verdict
from processing.quality.rules import above


def signal_findings(figures: QualityFigures, thresholds: Thresholds) -> list[Finding]:
    """Signal that a head or its read-out has changed.

    Args:
        figures: of one exposure.
        thresholds: limits.

    Returns:
        Findings about steps, balance, blocks, clipping and local blur.
    """
    findings = []
    steps, unread = figures.of(SignalStepFigures), figures.of(UnreadFigures)
    step = steps.signal_step
    # Lines that were not read out are a step, too.
    is_unread = (unread.unread_worst_fraction or 0.0) > thresholds.unread_fraction
    unread_sensor = unread.unread_worst_sensor if is_unread else None
    if step is not None and steps.signal_step_sensor != unread_sensor:
        lines = steps.signal_step_lines or 1
        where = f"{steps.signal_step_axis} of {steps.signal_step_sensor}"
        sentence = (
            f"The signal changes by {step:+.0%} after line {steps.signal_step_at} of the "
            f"{where}: gain or offset changed during read-out. Radiometry of this frame is wrong. "
            "Check the head."
        )
        if lines > 2:
            sentence = (
                f"The {where} show banding of {abs(step):.0%} in {lines} lines: check power "
                "supply and cable of the head. Radiometry of this frame is wrong."
            )
        if (steps.signal_step_frames or 1) > 2:
            sentence += (
                f" {steps.signal_step_frames} frames step while other heads show no such ground: "
                "check what these heads share, supply and clock."
            )
        findings.append(Finding(Flag.FRAME_CORRUPT, Verdict.USABLE, sentence, step))
    findings += _repeated_lines(figures.of(RepeatedLineFigures))
    findings += _defect_line(figures.of(DefectLineFigures))
    balance = figures.of(BalanceFigures)
    outlier, signal = balance.gain_outlier, balance.gain_outlier_signal
    if outlier and signal is not None:
        sentence = (
            f"Head {outlier} shows {signal:.2f} times the signal of the others in the "
            "overlaps: its exposure time, aperture or gain is not that of the record. The "
            "image is balanced to the other heads; its noise differs there. Check the head's "
            "settings."
        )
        if others := ", ".join(balance.gain_outlier_alternatives):
            sentence = (
                f"Head {outlier} shows {signal:.2f} times the signal of {others} in the overlaps, "
                "which cannot show which of them is wrong: exposure time, aperture or gain is not "
                "that of the record, and the level of the image may be wrong. Check the settings "
                "of these heads."
            )
        flag = Flag.UNDEREXPOSED if signal < 1.0 else Flag.OVEREXPOSED
        findings.append(Finding(flag, Verdict.USABLE, sentence, signal, 1.0))
    findings += _response(figures.of(ResponseFigures))
    findings += _block(figures.of(BlockFigures), thresholds)
    findings += _clipping(figures.of(ClippingFigures), thresholds)
    return findings + _blur(
        figures.of(RelativeSharpnessFigures), figures.of(LocalBlurFigures), thresholds
    )


def _repeated_lines(repeated: RepeatedLineFigures) -> list[Finding]:
    """Lines of a frame that repeat the line before, or a block of lines before."""
    lines, first = repeated.repeated_lines, repeated.repeated_lines_first
    source = repeated.repeated_lines_source
    if lines is None or first is None:
        return []
    sentence, verdict = (
        f"{lines} lines of {repeated.repeated_lines_sensor} from line {first} on repeat the line "
        "before: read-out or transfer stood still, and the image shows no ground there. Check the "
        "head and its cable.",
        Verdict.USABLE,
    )
    if source is not None and source < first - 1:
        sentence, verdict = (
            f"{lines} lines of {repeated.repeated_lines_sensor} from line {first} on repeat those "
            f"from line {source} on, word by word: they were sent twice, and the image shows other "
            "ground in one of both places. Check the head, cable and transfer. Fly this exposure "
            "again.",
            Verdict.REFLY,
        )
    return [Finding(Flag.FRAME_CORRUPT, verdict, sentence, float(lines))]


def _defect_line(line: DefectLineFigures) -> list[Finding]:
    """A line of a frame that shows no ground."""
    if line.defect_line is None:
        return []
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.USABLE,
            f"Line {line.defect_line_at} of the {line.defect_line_axis} of "
            f"{line.defect_line_sensor} differs from both neighbours by {line.defect_line:.0%}, "
            "while these are alike: calibration does not know this defect, or the read-out failed. "
            "The image shows no ground there. Calibrate the defects of the head.",
            line.defect_line,
        )
    ]


def _response(response: ResponseFigures) -> list[Finding]:
    """A PAN head whose signal against its neighbours depends on the light or on the place."""
    head, offset_dn = response.response_sensor, response.response_offset_dn
    if head is None:
        return []
    slope = response.response_slope or 0.0
    value, sentence = (
        slope,
        f"The signal of {head} against its neighbours changes by {slope:+.0%} from one side of its "
        f"frame to the other, along the {response.response_axis} of the image. Radiometry of this "
        "frame is wrong. Look for dew or shade on lens and filter; check aperture and calibration "
        "of the head.",
    )
    if offset_dn is not None:
        value, sentence = (
            offset_dn,
            f"The signal of {head} against its neighbours differs by {offset_dn:+.0f} DN in the "
            "dark: its dark signal was not subtracted, or its tone curve is another. Radiometry of "
            "this frame is wrong. Check black level, gain and lookup table of the head, and its "
            "calibration.",
        )
    if others := ", ".join(response.response_alternatives):
        sentence += f" Or it is {others}: the overlaps cannot show which head is wrong."
    return [Finding(Flag.FRAME_CORRUPT, Verdict.USABLE, sentence, value)]


def _block(block: BlockFigures, thresholds: Thresholds) -> list[Finding]:
    """A rectangle of a frame with another offset or gain."""
    step, step_dn = block.block_step, block.block_step_dn
    if step is None or step_dn is None or abs(step) <= thresholds.block_step:
        return []
    other = "columns" if block.block_axis == "rows" else "rows"
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.USABLE,
            f"A block of {block.block_sensor} differs by {step_dn:+.0f} DN ({step:+.0%}): "
            f"an edge after {str(block.block_axis)[:-1]} {block.block_at}, "
            f"{other} {block.block_first} to {block.block_last}, follows a line "
            "of pixels and no other head shows it. Radiometry of this frame is wrong. Check the "
            "head and its cable.",
            step,
            thresholds.block_step,
        )
    ]


def _clipping(clipping: ClippingFigures, thresholds: Thresholds) -> list[Finding]:
    """A frame that ends below full scale."""
    share, level_dn = clipping.clipped_fraction, clipping.clipped_dn
    if share is None or level_dn is None or share <= thresholds.clipped_fraction:
        return []
    return [
        Finding(
            Flag.OVEREXPOSED,
            Verdict.USABLE,
            f"Head {', '.join(clipping.clipped_sensors)} gives no signal above {level_dn} DN, "
            f"below full scale: {share:.1%} of the pixels of {clipping.clipped_sensor} lie at "
            "that value, and what is brighter is lost. Check gain, bits and lookup table of the "
            "head.",
            share,
            thresholds.clipped_fraction,
        )
    ]


def _blur(
    relative: RelativeSharpnessFigures, local: LocalBlurFigures, thresholds: Thresholds
) -> list[Finding]:
    """A PAN head, or a region of any frame, that is less sharp than others of the same ground."""
    findings = []
    if relative.noisy_sensor is not None and relative.noisy_share is not None:
        findings.append(
            Finding(
                Flag.FRAME_CORRUPT,
                Verdict.USABLE,
                f"Head {relative.noisy_sensor} has noise that its neighbour does not show: "
                f"{relative.noisy_share:.0%} of its detail is between single pixels, more than a "
                "lens leaves. Check the head, its cable and power supply.",
                relative.noisy_share,
            )
        )
    blurred, ratio = relative.blurred_sensor, relative.blurred_ratio
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
    for name, deficit, region, least in (
        (
            *(local.colour_blur_sensor, local.colour_blur_deficit, local.colour_blur_region),
            thresholds.colour_blur_deficit,
        ),
        (
            *(local.pan_blur_sensor, local.pan_blur_deficit, local.pan_blur_region),
            thresholds.pan_blur_deficit,
        ),
    ):
        if deficit is None or deficit <= least or name == blurred:
            continue
        findings.append(
            Finding(
                Flag.BLUR,
                Verdict.USABLE,
                f"{name} shows less fine detail than the other heads of the same ground in "
                f"{region}: out of focus, dew or smear. Check its lens.",
                deficit,
                least,
            )
        )
    return findings


def _dark(signal: SignalFigures, thresholds: Thresholds) -> list[Finding]:
    """An image without much light: black, noisy, or of dark ground."""
    bright, snr = signal.bright_fraction, signal.bright_snr
    if bright is None or bright >= thresholds.bright_fraction:
        return []
    if bright < thresholds.bright_refly_fraction:
        return [
            Finding(
                Flag.UNDEREXPOSED,
                Verdict.REFLY,
                "The image is black; check shutter, aperture and lens cover. Fly it again.",
                bright,
                thresholds.bright_refly_fraction,
            )
        ]
    sentence, verdict = (
        "The image is dark; lengthen the exposure or open the aperture.",
        Verdict.USABLE,
    )
    if snr is not None:
        sentence = (
            f"The image is dark: its bright parts have {snr:.0f} times their noise; lengthen the "
            "exposure or open the aperture."
        )
        verdict = Verdict.GOOD if snr >= thresholds.bright_snr else Verdict.USABLE
    return [Finding(Flag.UNDEREXPOSED, verdict, sentence, bright, thresholds.bright_fraction)]


def exposure_findings(figures: QualityFigures, thresholds: Thresholds) -> list[Finding]:
    """Exposure that is too dark, too bright or blurred.

    Args:
        figures: of one exposure.
        thresholds: limits.

    Returns:
        Findings about brightness, exposure times, saturation, smear and sharpness.
    """
    findings = _dark(figures.of(SignalFigures), thresholds)
    unknown = ", ".join(figures.of(UnknownExposureFigures).exposure_unknown_sensors)
    if unknown:
        findings.append(
            Finding(
                Flag.UNDEREXPOSED,
                Verdict.USABLE,
                f"The record states no exposure time of {unknown}: the colour balance is not "
                "verified, and one exposure cannot show it. Enter exposure_time_us in the record "
                "and process it again, or compare colours on the ground.",
            )
        )
    implausible = ", ".join(figures.of(ImplausibleExposureFigures).exposure_implausible_sensors)
    if implausible:
        findings.append(
            Finding(
                Flag.UNDEREXPOSED,
                Verdict.USABLE,
                f"The record states an impossible exposure time of {implausible}: it is not used, "
                "and their levels are not verified. Correct exposure_time_us in the record and "
                "process it again; check the head.",
            )
        )
    corrected = figures.of(ExposureScaleFigures)
    scale, scaled = corrected.exposure_scale, corrected.exposure_scaled_sensor
    if scale is not None and scale > thresholds.exposure_scale:
        findings.append(
            Finding(
                Flag.UNDEREXPOSED,
                Verdict.GOOD,
                f"Head {scaled} was exposed {1.0 / scale:.2f} times as long as the others, as its "
                f"record states: its level is corrected, its noise is {scale**0.5:.1f} times "
                "theirs. Check the exposure times.",
                scale,
                thresholds.exposure_scale,
            )
        )
    findings += above(
        figures.of(SaturationFigures).saturated_fraction,
        Flag.OVEREXPOSED,
        (thresholds.saturated_fraction, thresholds.saturated_refly_fraction),
        "Parts of the image are saturated; shorten the exposure.",
    )
    findings += _smear(figures.of(SmearFigures), thresholds)
    sharpness = figures.of(SharpnessFigures).sharpness
    if sharpness is not None and sharpness < thresholds.sharpness:
        findings.append(
            Finding(
                Flag.BLUR,
                Verdict.USABLE,
                "The image holds no fine detail; look at the quick look for cloud, dew or blur.",
                sharpness,
                thresholds.sharpness,
            )
        )
    return findings


def _smear(smear: SmearFigures, thresholds: Thresholds) -> list[Finding]:
    """Motion during exposure along and across track."""
    findings = []
    for smear_px, way in ((smear.smear_along_px, "along"), (smear.smear_across_px, "across")):
        sentence = (
            f"Motion blur {way} track; shorten the exposure, check TDI, speed, mount and crab."
        )
        if way == "along" and smear.tdi_shifts_max == 0:
            sentence = (
                "Motion blur along track, and the record states no TDI shifts. If the heads shift "
                "charges, enter settings.TdiShifts in the record and process it again. If not, "
                "shorten the exposure, check speed, mount and crab."
            )
        limits = (thresholds.smear_px, thresholds.smear_refly_px)
        findings += above(smear_px, Flag.BLUR, limits, sentence)
    return findings
