"""The quality report of one exposure: flags, the figures behind them, and the verdict.

The figures are in `processing.quality.figures`. How figures become findings is in
`processing.quality.evaluation`.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import Any, Final

from processing.quality.figures import QualityFigures


class Flag(enum.IntFlag):
    """The documented bit set (docs/reference/formats.md). A bit keeps its place in all versions."""

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
    UNCALIBRATED = 1 << 31
    PTP_FAULT = 1 << 32


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
    """What is known about one exposure; `figures` hold no NaN and no infinity."""

    verdict: Verdict
    flags: Flag
    findings: tuple[Finding, ...]
    figures: QualityFigures = field(default_factory=QualityFigures)


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
    bright_snr: float = 40.0
    """Of a dark image: below it noise shows, above it only the ground is dark and the verdict stays
    good. ISO 12232 takes 40 for an excellent image."""
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


def as_json(report: QualityReport) -> dict[str, Any]:
    """The report as JSON-ready data: no NaN, no infinity, flags by name.

    Args:
        report: of one exposure.

    Returns:
        Content of quality.json.
    """
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
        "figures": report.figures.as_json(),
    }


def _finite_value(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
