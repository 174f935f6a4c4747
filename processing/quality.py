"""The quality report of one exposure: flags, the figures behind them, and the verdict.

`judge` turns figures into findings; it measures nothing itself. Every figure has one documented
name (`FIGURES`), every flag one sentence that tells the operator what to do.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

Figure = float | int | str | None


class Flag(enum.IntFlag):
    """The documented bit set of DESIGN 5.11. A bit keeps its place for ever."""

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
    temperature_age_s: float = 30.0
    temperature_low_c: float = -40.0
    temperature_high_c: float = 70.0
    tie_points_per_overlap: int = 12
    tie_points_pp_refly: int = 20
    sigma0_px: float = 0.3
    sigma0_refly_px: float = 1.0
    bright_fraction: float = 0.06
    """The 95th percentile of the signal as a share of full scale; below, the image is dark."""
    bright_refly_fraction: float = 0.01
    saturated_fraction: float = 0.005
    saturated_refly_fraction: float = 0.05
    smear_px: float = 0.8
    smear_refly_px: float = 2.0
    sharpness: float = 0.26
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
    "relative_displacements": "pairs of sensors of one cone found displaced against each other",
    "undetermined": "sensors and cones the tie points did not place, held at calibration and TDM",
    "smear_along_px": "motion during exposure along track that TDI left, worst PAN cone, pixels",
    "smear_across_px": "the same across track",
    "gsd_m": "ground sampling distance of the virtual image",
    "saturated_fraction": "share of saturated pixels, all PAN sensors",
    "saturated_worst_fraction": "the same of the worst sensor",
    "saturated_worst_sensor": "which sensor that is",
    "mean_dn": "mean signal above black of the PAN sensors, DN",
    "bright_fraction": "95th percentile of PAN signal as a share of full scale",
    "balance_spread": "largest over smallest gain between PAN heads, less one",
    "sharpness": "share of the finest detail: 0.25 smooth, 1 without any correlation",
    "time_sigma_ns": "standard deviation of the exposure's time",
    "temperature_age_s": "age of the oldest temperature used",
    "valid_fraction": "share of virtual image pixels that hold data",
    "missing_sensors": "sensors without a frame, comma separated",
    "tilt_deg": "largest of roll and pitch",
    "crab_deg": "angle between the image's along axis and the track",
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
    Flag.MARK_MISSING: (
        Verdict.USABLE,
        "The receiver gave no event mark, the time is interpolated; check the strobe cable.",
    ),
    Flag.MARK_AMBIGUOUS: (
        Verdict.USABLE,
        "Two event marks could belong to this exposure; check the strobe line for noise.",
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
    Flag.GNSS: (
        Verdict.USABLE,
        "GNSS quality is poor; wait for a better fix before the next line if the plan allows.",
    ),
    Flag.DISK_LOW: (
        Verdict.GOOD,
        "The disk is nearly full; finish this line and change the disk.",
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
    thresholds: Thresholds | None = None,
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
    """
    t = thresholds or Thresholds()
    findings = [
        Finding(flag, *_CAPTURE[flag]) for flag in Flag if flag & capture_flags and flag in _CAPTURE
    ]
    findings += _frames(figures, capture_flags, missing_sensors, t)
    findings += _time_and_temperature(figures, missing_probes, probes_out_of_range, t)
    findings += _stitching(figures, nominal_bands, t)
    findings += _exposure(figures, t)
    findings += _attitude(figures, t)
    order = list(Verdict)
    worst = max((order.index(finding.verdict) for finding in findings), default=0)
    flags = capture_flags
    for finding in findings:
        flags |= finding.flag
    return QualityReport(order[worst], flags, tuple(findings), _finite(figures))


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
        "figures": _finite(report.figures),
    }


def _frames(
    figures: Mapping[str, Figure],
    capture_flags: Flag,
    missing_sensors: Sequence[str],
    t: Thresholds,
) -> list[Finding]:
    findings = []
    if missing_sensors or capture_flags & Flag.FRAME_MISSING:
        named = ", ".join(missing_sensors) or "a sensor"
        findings.append(
            Finding(
                Flag.FRAME_MISSING,
                Verdict.USABLE,
                f"No frame of {named}: that part has no data; check the head, fly again if the "
                "neighbours do not cover it.",
                float(len(missing_sensors)) or None,
                0.0,
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
    disagreeing = figures.get("dc_disagreement")
    if disagreeing:
        findings.append(
            Finding(
                Flag.DC_DISAGREEMENT,
                Verdict.USABLE,
                f"Probe and stitching disagree on the temperature of cone {disagreeing}: a stuck "
                "probe, a moved sensor or an old calibration; check the probe after landing.",
                _number(figures, "dc_estimated_k"),
            )
        )
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


def _stitching(
    figures: Mapping[str, Figure], nominal_bands: Sequence[str], t: Thresholds
) -> list[Finding]:
    findings = []
    poorest = _number(figures, "tie_points_min_overlap")
    if poorest is not None and poorest < t.tie_points_per_overlap:
        where = figures.get("tie_points_min_overlap_name") or "an overlap"
        total = _number(figures, "tie_points_pp") or 0.0
        too_few = total < t.tie_points_pp_refly
        findings.append(
            Finding(
                Flag.TIE_POINTS,
                Verdict.REFLY if too_few else Verdict.USABLE,
                f"Few tie points in {where} (water, snow, desert or cloud?): look at the quick "
                "look; fly again if it should have had detail.",
                poorest,
                float(t.tie_points_per_overlap),
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
    displaced = figures.get("displaced_sensor")
    if displaced:
        size = math.hypot(
            _number(figures, "displacement_x_px") or 0.0,
            _number(figures, "displacement_y_px") or 0.0,
        )
        findings.append(
            Finding(
                Flag.DISPLACED_SENSOR,
                Verdict.USABLE,
                f"Sensor {displaced} sits {size:.2f} px off its calibrated place; the image is "
                "corrected for it. Go on, and have the camera calibrated.",
                size,
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


def _finite(figures: Mapping[str, Figure]) -> dict[str, Figure]:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in figures.items()
    }


def _finite_value(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
