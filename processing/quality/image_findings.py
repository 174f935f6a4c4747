"""Findings about the pixels of an exposure: content, words, signal, exposure and sharpness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from processing.quality.report import Figure, Finding, Flag, Thresholds, Verdict
from processing.quality.rules import above, number


def content_findings(figures: Mapping[str, Figure], bands: Sequence[str]) -> list[Finding]:
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
            number(figures, "mismatched_positions"),
        )
    ]


def identity_findings(figures: Mapping[str, Figure]) -> list[Finding]:
    """Frames that are stored for another head than the one that took them."""
    frames, heads = figures.get("exchanged_frames"), figures.get("exchanged_from")
    if not frames or not heads:
        return []
    pairs = zip(str(frames).split(", "), str(heads).split(", "), strict=True)
    named = ", ".join(f"the frame of {frame} comes from head {head}" for frame, head in pairs)
    shown = "by the fixed pattern of their pixels"
    if figures.get("exchanged_by") == "geometry":
        shown = "by their places, or both heads have turned alike"
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY,
            f"{named[0].upper()}{named[1:]}, {shown}: heads or cables are exchanged, and bands or "
            "parts of the image are wrong. Check cables, addresses and serial numbers. The pixels "
            "stored are good; process them again with the frames in their places.",
        )
    ]


def word_format_findings(figures: Mapping[str, Figure]) -> list[Finding]:
    """Words in another format than the rig file states."""
    word_format = figures.get("word_format")
    if not word_format:
        return []
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY,
            f"The words of {figures.get('word_format_sensors')} are {word_format}, not as in the rig "
            "file: set the pixel format of the head, or `bits` and `justified` in the rig "
            "file. The pixels stored are good; process them again with the right rig file.",
        )
    ]


def signal_findings(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    """Signal that a head or its read-out has changed."""
    findings = []
    step = number(figures, "signal_step")
    # Lines that were not read out are a step, too.
    unread = number(figures, "unread_worst_fraction") or 0.0
    unread_sensor = figures.get("unread_worst_sensor") if unread > t.unread_fraction else None
    if step is not None and figures.get("signal_step_sensor") != unread_sensor:
        lines = number(figures, "signal_step_lines") or 1.0
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
    outlier, signal = figures.get("gain_outlier"), number(figures, "gain_outlier_signal")
    if outlier and signal is not None:
        findings.append(
            Finding(
                Flag.UNDEREXPOSED if signal < 1.0 else Flag.OVEREXPOSED,
                Verdict.USABLE,
                f"Head {outlier} shows {signal:.2f} times the signal of the others in the "
                "overlaps: its exposure time, aperture or gain is not that of the record. The "
                "image is balanced to the other heads; its noise differs there. Check the head's "
                "settings.",
                signal,
                1.0,
            )
        )
    return findings + _block(figures, t) + _clipping(figures, t) + _local_blur(figures, t)


def _block(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    """A rectangle of a frame with another offset or gain."""
    step, step_dn = number(figures, "block_step"), number(figures, "block_step_dn")
    if step is None or step_dn is None or abs(step) <= t.block_step:
        return []
    other = "columns" if figures.get("block_axis") == "rows" else "rows"
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.USABLE,
            f"A block of {figures.get('block_sensor')} differs by {step_dn:+.0f} DN ({step:+.0%}): "
            f"an edge after {str(figures.get('block_axis'))[:-1]} {figures.get('block_at')}, "
            f"{other} {figures.get('block_first')} to {figures.get('block_last')}, follows a line "
            "of pixels and no other head shows it. Radiometry of this frame is wrong. Check the "
            "head and its cable.",
            step,
            t.block_step,
        )
    ]


def _clipping(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    """A frame that ends below full scale."""
    share, level_dn = number(figures, "clipped_fraction"), number(figures, "clipped_dn")
    if share is None or level_dn is None or share <= t.clipped_fraction:
        return []
    return [
        Finding(
            Flag.OVEREXPOSED,
            Verdict.USABLE,
            f"Head {figures.get('clipped_sensors')} gives no signal above {level_dn:.0f} DN, below "
            f"full scale: {share:.1%} of the pixels of {figures.get('clipped_sensor')} lie at "
            "that value, and what is brighter is lost. Check gain, bits and lookup table of the "
            "head.",
            share,
            t.clipped_fraction,
        )
    ]


def _local_blur(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    """A PAN head, or a region of any frame, that is less sharp than others of the same ground."""
    findings = []
    blurred, ratio = figures.get("blurred_sensor"), number(figures, "blurred_ratio")
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
    for kind, least in (("colour", t.colour_blur_deficit), ("pan", t.pan_blur_deficit)):
        deficit = number(figures, f"{kind}_blur_deficit")
        name, region = figures.get(f"{kind}_blur_sensor"), figures.get(f"{kind}_blur_region")
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


def exposure_findings(figures: Mapping[str, Figure], t: Thresholds) -> list[Finding]:
    findings = []
    bright = number(figures, "bright_fraction")
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
    unknown = figures.get("exposure_unknown_sensors")
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
    scale, scaled = number(figures, "exposure_scale"), figures.get("exposure_scaled_sensor")
    if scale is not None and scale > t.exposure_scale:
        findings.append(
            Finding(
                Flag.UNDEREXPOSED,
                Verdict.GOOD,
                f"Head {scaled} was exposed {1.0 / scale:.2f} times as long as the others, as its "
                f"record states: its level is corrected, its noise is {scale**0.5:.1f} times "
                "theirs. Check the exposure times.",
                scale,
                t.exposure_scale,
            )
        )
    findings += above(
        figures,
        "saturated_fraction",
        Flag.OVEREXPOSED,
        (t.saturated_fraction, t.saturated_refly_fraction),
        "Parts of the image are saturated; shorten the exposure.",
    )
    for name, way in (("smear_along_px", "along"), ("smear_across_px", "across")):
        findings += above(
            figures,
            name,
            Flag.BLUR,
            (t.smear_px, t.smear_refly_px),
            f"Motion blur {way} track; shorten the exposure, check TDI, speed, mount and crab.",
        )
    sharpness = number(figures, "sharpness")
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
