"""The quality report of one exposure: flags, the figures behind them, and the verdict.

Every figure has one documented name (`FIGURES`). How figures become findings is in
`processing.quality.evaluation`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

Figure = float | int | str | None


class Flag(enum.IntFlag):
    """The documented bit set (docs/formats.md). A bit keeps its place in all versions."""

    FRAME_MISSING = 1 << 0
    FRAME_LATE = 1 << 1
    FRAME_DUPLICATE = 1 << 2
    FRAME_CORRUPT = 1 << 3
    MARK_MISSING = 1 << 4
    MARK_AMBIGUOUS = 1 << 5
    TIME_SIGMA = 1 << 6
    TEMPERATURE_MISSING = 1 << 7
    TEMPERATURE_STALE = 1 << 8
    TEMPERATURE_RANGE = 1 << 9
    DC_DISAGREEMENT = 1 << 10
    TIE_POINTS = 1 << 11
    SIGMA0 = 1 << 12
    DISPLACED_SENSOR = 1 << 13
    CALIBRATION_EXPIRED = 1 << 14
    UNDEREXPOSED = 1 << 15
    OVEREXPOSED = 1 << 16
    BLUR = 1 << 17
    TILT = 1 << 18
    DRIFT = 1 << 19
    OVERLAP = 1 << 20
    GNSS = 1 << 21
    DISK_LOW = 1 << 22
    PROCESSING_BEHIND = 1 << 23
    SIMULATED = 1 << 24
    NOT_PROCESSED = 1 << 25
    TIME_HOLDOVER = 1 << 26
    SUN = 1 << 27
    GSD = 1 << 28
    FRAME_AMBIGUOUS = 1 << 29
    NOT_MIRRORED = 1 << 30


NO_FLAGS: Final = Flag(0)


class Verdict(enum.Enum):
    GOOD = "good"
    USABLE = "usable"
    REFLY = "refly"


@dataclass(frozen=True)
class Finding:
    """One raised flag: which, how grave, the figure against its threshold, and what to do."""

    flag: Flag
    verdict: Verdict
    sentence: str
    value: float | None = None
    threshold: float | None = None


@dataclass(frozen=True)
class QualityReport:
    """What is known about one exposure. `figures` are numbers by documented name."""

    verdict: Verdict
    flags: Flag
    findings: tuple[Finding, ...]
    figures: Mapping[str, float | int | str | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Thresholds:
    """Where a figure becomes a finding. `*_refly` asks for another run over the same ground.

    Defaults suit a survey at 5 to 25 cm GSD and 60 to 100 m/s: 0.1 ms of time is below a tenth of a
    pixel there. A whole number of TDI shifts leaves up to half a pixel of smear, which is no fault.
    They are the configuration's to change.
    """

    time_sigma_ns: float = 100_000.0
    time_sigma_refly_ns: float = 20_000_000.0
    time_error_px: float = 0.1
    """Way flown in one standard deviation of time, as a fraction of the GSD."""
    time_error_refly_px: float = 10.0
    temperature_age_s: float = 30.0
    temperature_low_c: float = -40.0
    temperature_high_c: float = 70.0
    tie_points_per_overlap: int = 12
    tie_points_pp_refly: int = 20
    saturated_overlap_fraction: float = 0.5
    """Share of an overlap's matching windows that saturation spoils, above which it is the cause of
    too few tie points."""
    sigma0_px: float = 0.3
    sigma0_refly_px: float = 1.0
    bright_fraction: float = 0.06
    """The 95th percentile of the signal as a share of full scale; below, the image is dark."""
    bright_refly_fraction: float = 0.01
    unread_fraction: float = 0.01
    saturated_fraction: float = 0.005
    saturated_refly_fraction: float = 0.05
    smear_px: float = 0.8
    smear_refly_px: float = 2.0
    sharpness: float = 0.27
    displacement_verdict: float = 1.6
    """Test statistic over its critical value (0.1 %) from which a displaced sensor changes the
    verdict: of 100,000 healthy exposures one does. Below, the image is corrected and stays good."""
    colour_blur_deficit: float = 0.12
    """Share of the finest detail that is missing in a region of a colour frame against the others:
    0.25 is left without any, a sharp one has about 0.45."""
    pan_blur_deficit: float = 0.6
    """Natural logarithm of how many times less energy of detail a region of a PAN frame has."""
    exposure_scale: float = 1.25
    clipped_fraction: float = 0.003
    block_step: float = 0.02
    slip_refly_px: float = 0.5
    head_scale_ppm: float = 150.0
    """Of converging heads: calibrated principal distances agree to a tenth of it."""
    tilt_rad: float = math.radians(5.0)
    crab_rad: float = math.radians(5.0)
    valid_refly_fraction: float = 0.75


FIGURES: Final[Mapping[str, str]] = {
    "method": "how the image was stitched: free, fixed",
    "sigma0": "a posteriori standard deviation of unit weight",
    "sigma0_px": "sigma0 as one P/P coordinate difference, PAN pixels",
    "sigma0_um": "the same in um in the image plane",
    "redundancy": "redundancy of the adjustment",
    "outliers": "tie points rejected by data snooping",
    "tie_points_pp": "tie points between PAN sensors",
    "tie_points_pc": "tie points between PAN and the colour master",
    "tie_points_min_overlap": "tie points in the poorest overlap",
    "tie_points_min_overlap_name": "which overlap that is",
    "tie_points_min_overlap_burnt": "share of matching windows there that hold saturated pixels, "
    "where points are too few",
    "dc_k": "temperature at exposure less that at calibration, mean of the PAN cones, K",
    "dc_estimated_k": "the same as the stitching sees it, cones of two or more CCDs, K",
    "dc_estimated_sigma_k": "standard deviation of that; null where it cannot be determined",
    "dc_disagreement": "cones whose probes and stitching disagree, comma separated",
    "stitched_sigma_px": "standard deviation of a stitched point, RMS over PAN sensors, pixels",
    "stitched_sigma_worst_px": "the same of the worst PAN sensor",
    "stitched_sigma_worst_sensor": "which sensor that is",
    "displaced_sensor": "name of the one master sensor found displaced",
    "displacement_x_px": "its displacement against calibration and TDM, PAN pixels, x right",
    "displacement_y_px": "the same, y up",
    "displacement_sigma_px": "standard deviation of a coordinate of it",
    "displacement_test": "test statistic over its critical value; above one is significant",
    "displaced_alternatives": "master sensors that explain the stitching nearly as well",
    "displaced_several": "1 where one displaced sensor does not explain it all: several moved",
    "misread_probe": "probe of the master cone whose error explains the stitching as well as the "
    "displaced sensor; without one, better than any",
    "misread_k": "how much too high it reads then, K",
    "misread_sigma_k": "standard deviation of that",
    "relative_displacements": "pairs of sensors of one cone found displaced against each other",
    "platform_test": "mountings of converging heads, or scale and rotation of the layers of the "
    "other cones, against the platform calibration: test statistic over its critical value; above "
    "one is significant",
    "platform_shift_px": "how far the head that moved most went by it, PAN pixels at its middle",
    "platform_shift_head": "which head that is",
    "platform_causes": "cones whose change explains the layers, comma separated; the master's name "
    "where all others changed alike",
    "platform_alternatives": "cones that explain them nearly as well",
    "platform_master_changed": "1 where the master cone is among these: the image is not corrected",
    "common_scale_ppm": "change of scale that all layers share against calibration and drift",
    "common_scale_sigma_ppm": "standard deviation of that by calibration, drift and tie points",
    "mismatched_sensors": "frames with texture that match no neighbour, comma separated",
    "mismatched_positions": "textured positions of the worst of them that were tried",
    "shifted_sensors": "frames found farther from their calibrated place than points are sought",
    "shifted_px": "how far the farthest of them was, PAN pixels",
    "slip_sensor": "frame with a band of rows or columns that lies elsewhere than the rest",
    "slip_alternatives": "frames that explain the same tie points nearly as well",
    "slip_cone": "the cone of that frame",
    "slip_px": "by how much it is shifted, PAN pixels",
    "slip_axis": "rows or columns",
    "slip_first": "first row or column of the band, raw pixels",
    "slip_last": "last row or column of the band",
    "slip_sensors": "all frames with such a band, comma separated",
    "platform_residual_px": "largest shift an affine transformation still finds between heads",
    "platform_scale_ppm": "largest difference of scale between a converging head and its "
    "neighbours that its rotation does not explain",
    "platform_scale_head": "which head that is",
    "projection_height_m": "height above ground a virtual camera projected its heads onto",
    "head_parallax_px": "parallax relief may leave between PAN heads after that, PAN pixels",
    "undetermined": "sensors and cones the tie points did not place, held at calibration and TDM",
    "resting_on_calibration": "PAN sensors that tie points place too poorly, supported",
    "smear_along_px": "motion during exposure along track that TDI left, worst PAN cone, pixels",
    "smear_across_px": "the same across track",
    "smear_worst_head": "without a virtual image: the head whose ground moves farthest; the way's "
    "length, where the head sees it longest, is smear_along_px",
    "gsd_m": "ground sampling distance of the virtual image",
    "unread_worst_fraction": "share of the worst sensor's pixels far below black: not read out",
    "unread_worst_sensor": "which sensor that is",
    "saturated_fraction": "share of saturated pixels, all PAN sensors",
    "saturated_worst_fraction": "the same of the worst sensor",
    "saturated_worst_sensor": "which sensor that is",
    "mean_dn": "mean signal above black of the PAN sensors, DN",
    "bright_fraction": "95th percentile of PAN signal as a share of full scale",
    "balance_spread": "largest over smallest gain between PAN heads, less one",
    "gain_outlier": "PAN sensor whose signal in the overlaps is far off that of the others",
    "gain_outlier_signal": "its signal over theirs",
    "signal_step": "largest change of signal from one whole line of a frame to the next, relative",
    "signal_step_sensor": "the frame it is in",
    "signal_step_axis": "rows or columns",
    "signal_step_at": "the last line before it, raw pixels",
    "signal_step_lines": "lines of the frame where the signal steps; many are banding",
    "word_format": "what is wrong with the words of a frame: left-justified, byte-swapped, beyond "
    "the sensor's bits",
    "word_format_sensors": "the frames it is wrong in, comma separated",
    "blurred_sensor": "PAN sensor that is less sharp than its neighbours in their overlaps",
    "blurred_ratio": "its fine detail over theirs",
    "colour_blur_sensor": "colour sensor with the region that is least sharp against the other "
    "frames of the same ground",
    "colour_blur_deficit": "what is missing there of the share of the finest detail",
    "colour_blur_region": "which region, raw pixels",
    "pan_blur_sensor": "PAN sensor with the region that has least detail of its own pixels for "
    "what colour sees there",
    "pan_blur_deficit": "how many times less energy than usual, natural logarithm, beyond that "
    "of the next frame's region",
    "pan_blur_region": "which region, raw pixels",
    "exchanged_frames": "frames that another head took than the one they are stored for, comma "
    "separated",
    "exchanged_from": "the heads they came from, in the same order",
    "exchanged_by": "what shows it: fixed pattern, geometry",
    "exposure_unknown_sensors": "colour frames whose exposure time the record does not state while "
    "it states others, comma separated",
    "exposure_scaled_sensor": "frame whose level was corrected most for an exposure time other "
    "than that of the other cones",
    "exposure_scale": "what its signal was multiplied by",
    "red_over_pan": "signal of red over that of PAN on the same ground, median",
    "green_over_pan": "signal of green over that of PAN on the same ground, median",
    "blue_over_pan": "signal of blue over that of PAN on the same ground, median",
    "nir_over_pan": "signal of near infrared over that of PAN on the same ground, median",
    "clipped_sensor": "frame whose signal ends at one value below full scale",
    "clipped_sensors": "all such frames, comma separated",
    "clipped_dn": "that value, raw DN",
    "clipped_fraction": "share of its pixels there",
    "block_sensor": "frame with a block whose signal differs: its edges follow lines of pixels, "
    "and no other head shows them",
    "block_step_dn": "change of signal over its edge, DN",
    "block_step": "the same, relative",
    "block_axis": "the edge runs between two rows or two columns",
    "block_at": "the last line before it, raw pixels",
    "block_first": "first pixel of the edge in these lines",
    "block_last": "last pixel of it",
    "sharpness": "share of the finest detail: 0.25 smooth, 1 without any correlation",
    "time_sigma_ns": "standard deviation of the time of the least certain frame",
    "time_error_px": "way flown in that, speed x sigma, as a fraction of the GSD",
    "time_sigma_receiver_ns": "part of it: the receiver's event mark",
    "time_sigma_clock_ns": "part of it: the host's clock, where there is no mark",
    "time_sigma_trigger_ns": "part of it: when the pulse was given, where there is no mark",
    "time_sigma_delay_ns": "part of it: how well the trigger unit keeps its delays",
    "time_sigma_head_ns": "part of it: from the head's trigger to its mid-exposure",
    "temperature_age_s": "age of the oldest temperature used",
    "valid_fraction": "share of virtual image pixels that hold data",
    "missing_sensors": "sensors without a frame, comma separated",
    "valid_worst_fraction": "share of the image with valid pixels, of the band that has the least",
    "valid_worst_band": "which band that is",
    "tilt_deg": "largest of roll and pitch",
    "crab_deg": "angle between the image's along axis and the track",
    "forward_overlap": "share of the ground seen that the image before it on the line saw, too",
    "sidelap": "share of it that images of the neighbouring line saw, the poorer side",
    "sun_deg": "elevation of the sun",
    "tdi_shifts": "TDI shifts of the reference cone",
    "parallax_px": "parallax relief may leave between PAN and the colour master, PAN pixels",
    "green_rms_px": "residual of P/C tie points, colour pixels",
    "red_points": "tie points red to green",
    "red_rms_px": "residual of red to green, colour pixels",
    "blue_points": "tie points blue to green",
    "blue_rms_px": "residual of blue to green, colour pixels",
    "nir_points": "tie points near infrared to green",
    "nir_rms_px": "residual of near infrared to green, colour pixels",
}
"""Documented names of figures; `dc_k_<cone>` is one cone's own dC, K."""


def as_json(report: QualityReport) -> dict[str, Any]:
    """The report as JSON-ready data: no NaN, no infinity, flags by name."""
    return {
        "verdict": report.verdict.value,
        "flags": [flag.name for flag in Flag if flag & report.flags],
        "flag_bits": int(report.flags),
        "findings": [
            {
                "flag": finding.flag.name,
                "verdict": finding.verdict.value,
                "sentence": finding.sentence,
                "value": _finite_value(finding.value),
                "threshold": _finite_value(finding.threshold),
            }
            for finding in report.findings
        ],
        "figures": finite(report.figures),
    }


def finite(figures: Mapping[str, Figure]) -> dict[str, Figure]:
    """The figures with None for what is no number, as JSON wants them."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in figures.items()
    }


def _finite_value(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
