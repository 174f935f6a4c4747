"""Figures of the pixels: content, words, signal, sharpness, valid area."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from processing.quality.figures.group import FigureGroup, Key, Names


@dataclass(frozen=True)
class ContentFigures(FigureGroup):
    """Frames that show other ground than their neighbours, or lie elsewhere."""

    mismatched_sensors: Annotated[
        Names,
        "frames with texture that match no neighbour, comma separated",
    ] = ()
    mismatched_positions: Annotated[
        int | None,
        "textured positions of the worst of them that were tried",
    ] = None
    mismatched_alternatives: Annotated[
        Names,
        "frames that may show other ground instead: PAN heads, and colour heads that agree with "
        "green",
    ] = ()
    shifted_sensors: Annotated[
        Names,
        "frames found farther from their calibrated place than points are sought",
    ] = ()
    shifted_px: Annotated[float | None, "how far the farthest of them was, PAN pixels"] = None


@dataclass(frozen=True)
class OtherGroundFigures(FigureGroup):
    """A region of a frame that shows other ground than the other heads."""

    other_ground_sensor: Annotated[
        str | None, "frame of which a region with texture matches no other head"
    ] = None
    other_ground_alternatives: Annotated[
        Names, "frames that may be wrong instead, or that have such a region too"
    ] = ()
    other_ground_first_column: Annotated[int | None, "first column of the region"] = None
    other_ground_last_column: Annotated[int | None, "its last column"] = None
    other_ground_first_row: Annotated[int | None, "first row of the region"] = None
    other_ground_last_row: Annotated[int | None, "its last row"] = None
    other_ground_positions: Annotated[int | None, "textured positions in it that match nothing"] = (
        None
    )


@dataclass(frozen=True)
class ConfirmedGroundFigures(FigureGroup):
    """How much of a frame other heads show as well."""

    confirmed_least_fraction: Annotated[
        float | None,
        "share of the 8 by 8 parts of a frame where points match those of another head, of the "
        "frame that has the least; in the others a part of another exposure may stay unseen",
    ] = None
    confirmed_least_sensor: Annotated[str | None, "which frame that is"] = None


@dataclass(frozen=True)
class UnreadFigures(FigureGroup):
    """Pixels that were not read out."""

    unread_worst_fraction: Annotated[
        float | None,
        "share of the worst sensor's pixels far below black: not read out",
    ] = None
    unread_worst_sensor: Annotated[str | None, "which sensor that is"] = None


@dataclass(frozen=True)
class DarkFrameFigures(FigureGroup):
    """Frames without light while others are lit."""

    dark_sensors: Annotated[
        Names, "frames without light while those of other heads are lit, comma separated"
    ] = ()
    dark_noises: Annotated[
        float | None,
        "95th percentile of the signal of the brightest of them, standard deviations of read noise",
    ] = None


@dataclass(frozen=True)
class RepeatedLineFigures(FigureGroup):
    """Lines that repeat the line before, or a block of lines before."""

    repeated_lines: Annotated[
        int | None, "longest run of lines of a frame that are earlier lines of it, word by word"
    ] = None
    repeated_lines_sensor: Annotated[str | None, "the frame it is in"] = None
    repeated_lines_first: Annotated[int | None, "first line of the run"] = None
    repeated_lines_source: Annotated[
        int | None, "the line that the first one repeats: the line before, or one farther back"
    ] = None


@dataclass(frozen=True)
class DefectLineFigures(FigureGroup):
    """A line of a frame that shows no ground."""

    defect_line: Annotated[
        float | None,
        "how much a line of a frame differs from both neighbours over its whole length, relative",
    ] = None
    defect_line_sensor: Annotated[str | None, "the frame it is in"] = None
    defect_line_axis: Annotated[str | None, "rows or columns"] = None
    defect_line_at: Annotated[int | None, "the line, raw pixels"] = None


@dataclass(frozen=True)
class SaturationFigures(FigureGroup):
    """Saturated pixels."""

    saturated_fraction: Annotated[float | None, "share of saturated pixels, all PAN sensors"] = None
    saturated_worst_fraction: Annotated[float | None, "the same of the worst sensor"] = None
    saturated_worst_sensor: Annotated[str | None, "which sensor that is"] = None


@dataclass(frozen=True)
class SignalFigures(FigureGroup):
    """Brightness of the image."""

    mean_dn: Annotated[float | None, "mean signal above black of the PAN sensors, DN"] = None
    bright_fraction: Annotated[
        float | None,
        "95th percentile of PAN signal as a share of full scale",
    ] = None
    bright_snr: Annotated[
        float | None,
        "its signal over its noise of photons and read-out, of the noisiest sensor",
    ] = None


@dataclass(frozen=True)
class SharpnessFigures(FigureGroup):
    """Fine detail of the image."""

    sharpness: Annotated[
        float | None,
        "share of the finest detail: 0.25 smooth, 1 without any correlation",
    ] = None


@dataclass(frozen=True)
class BalanceFigures(FigureGroup):
    """Signal of the PAN heads against each other."""

    balance_spread: Annotated[
        float | None,
        "largest over smallest gain between PAN heads, less one",
    ] = None
    gain_outlier: Annotated[
        str | None,
        "PAN sensor whose signal in the overlaps is far off that of the others",
    ] = None
    gain_outlier_signal: Annotated[float | None, "its signal over theirs"] = None
    gain_outlier_alternatives: Annotated[
        Names, "sensors whose signal may be wrong instead: the overlaps differ by it as well"
    ] = ()


@dataclass(frozen=True)
class ResponseFigures(FigureGroup):
    """How the PAN heads respond to the light they share."""

    response_sensor: Annotated[
        str | None,
        "PAN sensor whose signal against its neighbours depends on the light or on the place in "
        "its frame",
    ] = None
    response_offset_dn: Annotated[
        float | None, "its offset against them, DN; another tone curve looks like one, too"
    ] = None
    response_slope: Annotated[
        float | None, "change of its signal from one side of its frame to the other, relative"
    ] = None
    response_axis: Annotated[
        str | None, "along which the slope is: rows or columns of the image"
    ] = None
    response_alternatives: Annotated[
        Names, "sensors whose response may be wrong instead: the overlaps show it as well"
    ] = ()
    response_limit_dn: Annotated[
        float | None,
        "offset of a PAN frame, of that with the least light and dark in its overlaps, below "
        "which it is not distinguished from another gain, DN",
    ] = None


@dataclass(frozen=True)
class SignalStepFigures(FigureGroup):
    """Steps of the signal from line to line."""

    signal_step: Annotated[
        float | None,
        "largest change of signal from one whole line of a frame to the next, relative",
    ] = None
    signal_step_sensor: Annotated[str | None, "the frame it is in"] = None
    signal_step_axis: Annotated[str | None, "rows or columns"] = None
    signal_step_at: Annotated[int | None, "the last line before it, raw pixels"] = None
    signal_step_lines: Annotated[
        int | None,
        "lines of the frame where the signal steps; many are banding",
    ] = None
    signal_step_frames: Annotated[
        int | None,
        "frames with such a step; several at once have a cause that their heads share",
    ] = None


@dataclass(frozen=True)
class BlockFigures(FigureGroup):
    """Blocks of a frame with another offset or gain."""

    block_sensor: Annotated[
        str | None,
        "frame with a block whose signal differs: its edges follow lines of pixels, and no "
        "other head shows them",
    ] = None
    block_step_dn: Annotated[float | None, "change of signal over its edge, DN"] = None
    block_step: Annotated[float | None, "the same, relative"] = None
    block_axis: Annotated[str | None, "the edge runs between two rows or two columns"] = None
    block_at: Annotated[int | None, "the last line before it, raw pixels"] = None
    block_first: Annotated[int | None, "first pixel of the edge in these lines"] = None
    block_last: Annotated[int | None, "last pixel of it"] = None
    block_limit_dn: Annotated[
        float | None,
        "offset of a block from which on it is found in any frame of this exposure, DN; smaller "
        "ones may be in the image, where the ground's texture hides them",
    ] = None
    block_limit_sensor: Annotated[str | None, "the frame whose texture hides most"] = None


@dataclass(frozen=True)
class LineOrderFigures(FigureGroup):
    """Lines of a raw frame that do not follow from their neighbours."""

    line_order: Annotated[
        float | None, "how much more neighbouring lines of a frame differ than their place explains"
    ] = None
    line_order_sensor: Annotated[str | None, "the frame it is in"] = None
    line_order_axis: Annotated[str | None, "rows or columns"] = None


@dataclass(frozen=True)
class WordFormatFigures(FigureGroup):
    """Words in another format than the rig file states."""

    word_format: Annotated[
        Names,
        "what is wrong with the words of a frame: left-justified, byte-swapped, beyond the "
        "sensor's bits",
    ] = ()
    word_format_sensors: Annotated[Names, "the frames it is wrong in, comma separated"] = ()
    constant_bits: Annotated[
        Names, "bits of values that never change although the values do, 0 is the lowest"
    ] = ()
    constant_bits_sensors: Annotated[Names, "the frames they are in, comma separated"] = ()


@dataclass(frozen=True)
class RelativeSharpnessFigures(FigureGroup):
    """A PAN sensor less sharp than its neighbours."""

    blurred_sensor: Annotated[
        str | None,
        "PAN sensor that is less sharp than its neighbours in their overlaps",
    ] = None
    blurred_ratio: Annotated[float | None, "its fine detail over theirs"] = None
    noisy_sensor: Annotated[
        str | None, "PAN sensor with more of the finest detail than a lens leaves: noise"
    ] = None
    noisy_share: Annotated[float | None, "its share of the finest detail; noise alone has 1"] = None


@dataclass(frozen=True)
class LocalBlurFigures(FigureGroup):
    """The least sharp regions."""

    colour_blur_sensor: Annotated[
        str | None,
        "colour sensor with the region that is least sharp against the other frames of the "
        "same ground",
    ] = None
    colour_blur_deficit: Annotated[
        float | None,
        "what is missing there of the share of the finest detail",
    ] = None
    colour_blur_region: Annotated[str | None, "which region, raw pixels"] = None
    pan_blur_sensor: Annotated[
        str | None,
        "PAN sensor with the region that has least detail of its own pixels for what colour "
        "sees there",
    ] = None
    pan_blur_deficit: Annotated[
        float | None,
        "how many times less energy than usual, natural logarithm, beyond that of the next "
        "frame's region",
    ] = None
    pan_blur_region: Annotated[str | None, "which region, raw pixels"] = None


@dataclass(frozen=True)
class IdentityFigures(FigureGroup):
    """Frames that another head took."""

    exchanged_frames: Annotated[
        Names,
        "frames that another head took than the one they are stored for, comma separated",
    ] = ()
    exchanged_from: Annotated[Names, "the heads they came from, in the same order"] = ()
    exchanged_by: Annotated[str | None, "what shows it: fixed pattern, geometry"] = None


@dataclass(frozen=True)
class BandLevelFigures(FigureGroup):
    """Signal of the bands against PAN, by band."""

    level_by_band: Annotated[
        Mapping[str, float | None],
        "signal of a band over that of PAN on the same ground, median",
        Key("<band>_over_pan"),
    ] = field(default_factory=dict)


@dataclass(frozen=True)
class ClippingFigures(FigureGroup):
    """A signal that ends below full scale."""

    clipped_sensor: Annotated[
        str | None,
        "frame whose signal ends at one value below full scale",
    ] = None
    clipped_sensors: Annotated[Names, "all such frames, comma separated"] = ()
    clipped_dn: Annotated[int | None, "that value, raw DN"] = None
    clipped_fraction: Annotated[float | None, "share of its pixels there"] = None


@dataclass(frozen=True)
class ValidFigures(FigureGroup):
    """Data in the image."""

    valid_fraction: Annotated[float | None, "share of virtual image pixels that hold data"] = None


@dataclass(frozen=True)
class ValidAreaFigures(FigureGroup):
    """Valid area of the band that has the least."""

    valid_worst_fraction: Annotated[
        float | None,
        "share of the image with valid pixels, of the band that has the least",
    ] = None
    valid_worst_band: Annotated[str | None, "which band that is"] = None
