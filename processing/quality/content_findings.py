"""Findings about what a frame shows: the ground, light, of which head, and in which words."""

from __future__ import annotations

from collections.abc import Sequence

from processing.quality.figures import QualityFigures
from processing.quality.figures.image import (
    ContentFigures,
    DarkFrameFigures,
    IdentityFigures,
    LineOrderFigures,
    OtherGroundFigures,
    WordFormatFigures,
)
from processing.quality.report import Finding, Flag, Verdict


def content_findings(figures: QualityFigures, bands: Sequence[str]) -> list[Finding]:
    """Frames with texture that show other ground than their neighbours.

    Args:
        figures: of one exposure.
        bands: bands whose texture does not match that of green.

    Returns:
        One finding or none.
    """
    content, misread = figures.of(ContentFigures), figures.of(WordFormatFigures)
    frames = [f for f in content.mismatched_sensors if f not in misread.word_format_sensors]
    named = ", ".join([*frames, *bands])
    if not named:
        return []
    positions = content.mismatched_positions
    sentence = (
        f"The frame of {named} shows other ground than its neighbours although it has texture: "
        "frames swapped, of another exposure, turned or mirrored, or the head has moved. "
        "Check cables and serial numbers of the heads. Fly this exposure again."
    )
    if content.mismatched_alternatives and not bands:
        sentence = (
            f"The frame of {named} shows other ground than the PAN heads, and other colour heads "
            "agree with it: the frames of all PAN heads or of all colour heads are of another "
            "exposure. Check the trigger and the numbering of both. Fly this exposure again."
        )
    value = None if positions is None else float(positions)
    return [Finding(Flag.FRAME_CORRUPT, Verdict.REFLY, sentence, value)]


def other_ground_findings(figures: QualityFigures) -> list[Finding]:
    """A region of a frame that shows other ground.

    Args:
        figures: of one exposure.

    Returns:
        One finding or none.
    """
    region = figures.of(OtherGroundFigures)
    name, positions = region.other_ground_sensor, region.other_ground_positions
    if name is None or positions is None:
        return []
    others = ", ".join(region.other_ground_alternatives)
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY,
            f"Columns {region.other_ground_first_column} to {region.other_ground_last_column}, "
            f"rows {region.other_ground_first_row} to {region.other_ground_last_row} of {name} "
            + (f"(or of {others} at the same place) " if others else "")
            + "show other ground than the other heads although they have texture: a part of "
            "another exposure. Check the head, cable and transfer. Fly this exposure again.",
            float(positions),
        )
    ]


def dark_frame_findings(figures: QualityFigures) -> list[Finding]:
    """Frames without light while other heads are lit.

    Args:
        figures: of one exposure.

    Returns:
        One finding or none.
    """
    dark = figures.of(DarkFrameFigures)
    if not dark.dark_sensors:
        return []
    return [
        Finding(
            Flag.FRAME_CORRUPT,
            Verdict.REFLY,
            f"No light in the frame of {', '.join(dark.dark_sensors)} while other heads are lit: "
            "shutter or lens cover was closed, or the head gave no signal, and the image shows no "
            "ground there. Check shutter, lens cover and head. Fly this exposure again.",
            dark.dark_noises,
        )
    ]


def identity_findings(figures: QualityFigures) -> list[Finding]:
    """Frames that are stored for another head than the one that took them.

    Args:
        figures: of one exposure.

    Returns:
        One finding or none.
    """
    identity = figures.of(IdentityFigures)
    if not identity.exchanged_frames:
        return []
    pairs = zip(identity.exchanged_frames, identity.exchanged_from, strict=True)
    named = ", ".join(f"the frame of {frame} comes from head {head}" for frame, head in pairs)
    shown = "by the fixed pattern of their pixels"
    if identity.exchanged_by == "geometry":
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


def word_format_findings(figures: QualityFigures) -> list[Finding]:
    """Words in another format than the rig file states, and lines in another order.

    Args:
        figures: of one exposure.

    Returns:
        Findings, none where all words are as stated.
    """
    words, found = figures.of(WordFormatFigures), []
    if words.word_format:
        sensors, word_format = ", ".join(words.word_format_sensors), ", ".join(words.word_format)
        found.append(
            Finding(
                Flag.FRAME_CORRUPT,
                Verdict.REFLY,
                f"The words of {sensors} are {word_format}, not as in the rig file: set the pixel "
                "format of the head, or `bits` and `justified` in the rig file. The pixels stored "
                "are good; process them again with the right rig file.",
            )
        )
    if words.constant_bits:
        sensors, bits = ", ".join(words.constant_bits_sensors), ", ".join(words.constant_bits)
        found.append(
            Finding(
                Flag.FRAME_CORRUPT,
                Verdict.REFLY,
                f"Of the values of {sensors} these bits never change: {bits}. A line of the "
                "read-out is stuck, or the head gives fewer bits than the rig file states. Check "
                "the head and its pixel format, and fly again.",
            )
        )
    order = figures.of(LineOrderFigures)
    if order.line_order is not None:
        found.append(
            Finding(
                Flag.FRAME_CORRUPT,
                Verdict.REFLY,
                f"Neighbouring {order.line_order_axis} of {order.line_order_sensor} do not follow "
                f"from each other: they differ {order.line_order:.1f} times as much as their place "
                "explains. Lines are exchanged, of two exposures or of two gains, or the colour "
                "filter array is not that of the rig file. Check the head and the rig file, and "
                "fly again.",
                order.line_order,
            )
        )
    return found
