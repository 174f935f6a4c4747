"""The report of a mission: one self-contained HTML file.

It draws what the records and quality reports say; nothing is computed here that they do not hold.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from html import escape
from pathlib import Path
from typing import Any, TypeVar

import jinja2

from daemon import DaemonError
from daemon.mission.exposure import Exposure, to_json
from daemon.mission.exposure_batch import ExposureFailure, cause_of, for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.operator_decisions import manual_verdicts, read_decisions
from daemon.mission.store.durable import make_directories, replace_file
from daemon.mission.store.level0_folder import read_sealed
from daemon.mission.store.level2 import read_report
from daemon.mission.store.output_places import refuse_foreign_file
from daemon.onboard.flight.flag_table import FLAG_TABLE
from daemon.planning.flight_map import flight_map
from daemon.planning.mission_coverage import coverage_of
from daemon.postflight.displacements import flight_displacements, write_displacements
from daemon.products.exposure_conditions import GPS_EPOCH
from daemon.terminal.console import visible_value
from drivers.timescales.leap_seconds import leap_seconds_at
from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import DcFigures
from processing.quality.figures.image import BandLevelFigures
from processing.quality.figures.stitching import (
    AdjustmentFigures,
    DisplacedSensorFigures,
    DisplacementFigures,
    DisplacementTestFigures,
    MisreadProbeFigures,
)
from processing.quality.level_steps import level_steps
from processing.rig import RigError

REPORT_FILE = "report.html"
T = TypeVar("T")

_TIME_PARTS = ("receiver", "clock", "trigger", "delay", "head")
_GLYPHS = {"good": "●", "usable": "▲", "refly": "■", "lost": "✕"}


@dataclass(frozen=True)
class WrittenReport:
    """The page, and what of exposures could not be read and is not in it."""

    path: Path
    failures: tuple[ExposureFailure, ...]


def write_report(
    mission: Path,
    *,
    ledger: Mapping[str, Any] | None = None,
    geometry: Mapping[str, Any] | None = None,
    out: Path | None = None,
) -> WrittenReport:
    """Write `report.html` into the mission's export folder, or into another one.

    Args:
        mission: the mission folder.
        ledger: the balance sheet, where the service just emitted it.
        geometry: comparison with an emulator's truth, where there is one.
        out: another folder; nothing is written into the mission then.

    Raises:
        OutputPlaceError: `out` holds a `report.html` that is not of this mission.
        OSError: the disk refused.
    """
    folder = Mission.open(mission)
    path = (out or mission / "export") / REPORT_FILE
    if out is not None:
        title = f"<title>{escape(mission.name)}</title>".encode()
        refuse_foreign_file(path, lambda head: title in head, cure="give another folder with --out")
    read = for_each_exposure(folder.numbers(), lambda number: _exposure(folder, number))
    exposures = [exposure for exposure, _ in read.results.values()]
    manual = manual_verdicts(read_decisions(mission))
    for exposure in exposures:
        exposure["manual"] = manual.get(exposure["number"])
    failures = [*read.failures, *(one for _, found in read.results.values() for one in found)]
    displacements = (
        flight_displacements(mission) if out is not None else write_displacements(mission)
    )
    coverage = _coverage(mission)
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    environment = jinja2.Environment(
        loader=loader,
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=visible_value,
    )
    html = environment.get_template("report.html").render(
        mission=mission.name,
        coverage=coverage,
        flight_map=_flight_map(mission, exposures, coverage),
        exposures=exposures,
        simulated=any(exposure["record"].get("simulated") for exposure in exposures),
        displaced=_displaced(exposures),
        tested=len(_series(exposures, _displacement_test)),
        flight_sentences=[*displacements["sentences"], *_level_steps(exposures)],
        tips=_tips(exposures),
        unreadable=failures,
        ledger=ledger,
        geometry=geometry,
        plots=[
            _plot("dC by cone, K", _temperature_series(exposures)),
            _plot("sigma0, px", {"sigma0": _series(exposures, _sigma0_px)}),
            _plot("Sigma of the exposure's time, ns", {"sigma": _time_sigma(exposures)}),
        ],
        glyphs=_GLYPHS,
        time_parts=_TIME_PARTS,
    )
    make_directories(path.parent)
    replace_file(path, html.encode("utf-8"))
    return WrittenReport(path, tuple(failures))


def _tips(exposures: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What to do about each flag of the flight, the most frequent flag first."""
    counts = Counter(
        flag
        for exposure in exposures
        for flag in dict.fromkeys(exposure["report"].get("flags", []))
    )
    known = {entry.name: entry for entry in FLAG_TABLE}
    return [
        {"flag": flag, "count": count, "cause": known[flag].cause, "action": known[flag].action}
        for flag, count in counts.most_common()
        if flag in known
    ]


def _coverage(mission: Path) -> dict[str, Any] | None:
    """Coverage of the plan; None without a plan, or one that cannot be used."""
    try:
        return coverage_of(Mission.open(mission))
    except (OSError, DaemonError, RigError):
        return None


def _flight_map(
    mission: Path, exposures: Sequence[Mapping[str, Any]], coverage: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """The map of lines, footprints and gaps; None where there is nothing to draw."""
    verdicts = {one["number"]: one["verdict"] for one in exposures}
    try:
        return flight_map(Mission.open(mission), verdicts, (coverage or {}).get("segments", ()))
    except (OSError, DaemonError, RigError):
        return None


def _exposure(mission: Mission, number: int) -> tuple[dict[str, Any], list[ExposureFailure]]:
    """Content of the page for an exposure, and what of it cannot be read."""
    level2 = mission.level2(number)
    failures: list[ExposureFailure] = []

    def readable(read: Callable[[], T], otherwise: T) -> T:
        try:
            return read()
        except (OSError, DaemonError) as error:
            failures.append(ExposureFailure(number, cause_of(error)))
            return otherwise

    sealed = readable(lambda: read_sealed(mission.level0(number)), None)
    record = to_json(Exposure(number) if sealed is None else sealed.exposure)
    state = "unknown" if sealed is None else sealed.exposure.state
    report = readable(lambda: read_report(level2), None) or {}
    figures = QualityFigures.from_json(report.get("figures", {}))
    entry = {
        "number": number,
        "record": record,
        "report": report,
        "verdict": report.get("verdict", state),
        "figures": figures,
        "shown": figures.as_json(),
        "findings": report.get("findings", []),
        "gps": _gps_text(record.get("mark_gps_ns")),
        "utc": _utc_text(record.get("mark_gps_ns")),
        "worst_time_sigma_ns": _worst_time_sigma(record),
        "quicklook": readable(lambda: _data_uri(level2 / "quicklook.jpg", "image/jpeg"), None),
        "residuals": readable(lambda: _data_uri(level2 / "residuals.svg", "image/svg+xml"), None),
    }
    return entry, failures


def _data_uri(path: Path, kind: str) -> str | None:
    if not path.exists():
        return None
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _gps_text(gps_ns: str | None) -> str:
    if gps_ns is None:
        return "unknown"
    seconds, nanoseconds = divmod(int(gps_ns), 1_000_000_000)
    week, second = divmod(seconds, 604_800)
    return f"week {week}, {second}.{nanoseconds:09d} s"


def _utc_text(gps_ns: str | None) -> str:
    """UTC to the millisecond, by the table of leap seconds."""
    if gps_ns is None:
        return "unknown"
    leap = timedelta(seconds=leap_seconds_at(int(gps_ns)))
    utc = GPS_EPOCH + timedelta(microseconds=int(gps_ns) // 1000) - leap
    return utc.strftime("%Y-%m-%d %H:%M:%S.") + f"{utc.microsecond // 1000:03d}"


def _worst_time_sigma(record: Mapping[str, Any]) -> int | None:
    sigmas = [frame.get("time_sigma_ns") for frame in record.get("frames", [])]
    return max((sigma for sigma in sigmas if sigma is not None), default=None)


def _displaced(exposures: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The displaced sensor, its number of exposures, and its mean displacement."""
    found: dict[str, list[DisplacementFigures]] = {}
    for figures in (exposure["figures"] for exposure in exposures):
        name = figures.of(DisplacedSensorFigures).displaced_sensor
        probe = figures.of(MisreadProbeFigures).misread_probe
        if name and probe:
            name = f"{name}, or probe {probe} misreads"
        if name:
            found.setdefault(name, []).append(figures.of(DisplacementFigures))
    return [
        {
            "sensor": name,
            "count": len(moved),
            "x_px": _mean(one.displacement_x_px for one in moved),
            "y_px": _mean(one.displacement_y_px for one in moved),
        }
        for name, moved in found.items()
    ]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _temperature_series(
    exposures: Sequence[Mapping[str, Any]],
) -> dict[str, list[tuple[int, float]]]:
    series: dict[str, list[tuple[int, float]]] = {}
    for exposure in exposures:
        for cone, dc_k in exposure["figures"].of(DcFigures).dc_k_by_cone.items():
            if dc_k is not None:
                series.setdefault(cone, []).append((exposure["number"], dc_k))
    return series or {"mean": _series(exposures, lambda figures: figures.of(DcFigures).dc_k)}


def _level_steps(exposures: Sequence[Mapping[str, Any]]) -> list[str]:
    """Bands whose level changed alone from one exposure to the next, one message each."""
    levels = {
        exposure["number"]: {
            band: level
            for band, level in exposure["figures"].of(BandLevelFigures).level_by_band.items()
            if level is not None
        }
        for exposure in exposures
    }
    return [step.sentence for step in level_steps(levels)]


def _displacement_test(figures: QualityFigures) -> float | None:
    return figures.of(DisplacementTestFigures).displacement_test


def _sigma0_px(figures: QualityFigures) -> float | None:
    return figures.of(AdjustmentFigures).sigma0_px


def _series(
    exposures: Sequence[Mapping[str, Any]], figure: Callable[[QualityFigures], float | None]
) -> list[tuple[int, float]]:
    """A figure by exposure number, where it is determined."""
    values = ((exposure["number"], figure(exposure["figures"])) for exposure in exposures)
    return [(number, value) for number, value in values if value is not None]


def _time_sigma(exposures: Sequence[Mapping[str, Any]]) -> list[tuple[int, float]]:
    return [
        (exposure["number"], float(exposure["record"]["mark_sigma_ns"]))
        for exposure in exposures
        if exposure["record"].get("mark_sigma_ns") is not None
    ]


def _plot(title: str, series: Mapping[str, Sequence[tuple[int, float]]]) -> dict[str, Any]:
    """A small line plot: polylines in a box of 600 x 140, with its scale."""
    points = [point for line in series.values() for point in line]
    if not points:
        return {"title": title, "lines": [], "low": "", "high": "", "first": "", "last": ""}
    xs = [x for x, _ in points]
    ys = [y for _, y in points]
    low, high = min(ys), max(ys)
    margin = 0.1 * (high - low) or max(abs(high) * 0.1, 0.1)
    low, high = low - margin, high + margin
    span = max(max(xs) - min(xs), 1)
    lines = [
        {
            "name": name,
            "points": " ".join(
                f"{(x - min(xs)) / span * 560 + 20:.1f},{130 - (y - low) / (high - low) * 120:.1f}"
                for x, y in line
            ),
            "hue": round(360 * index / max(len(series), 1)),
        }
        for index, (name, line) in enumerate(series.items())
    ]
    return {
        "title": title,
        "lines": lines,
        "low": f"{low:.3g}",
        "high": f"{high:.3g}",
        "first": str(min(xs)),
        "last": str(max(xs)),
    }
