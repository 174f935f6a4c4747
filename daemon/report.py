"""The report of a mission: one HTML file that needs nothing beside it.

It draws what the records and quality reports say; nothing is computed here that they do not hold.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from daemon.displacements import write_displacements
from processing.conditions import TIME_PARTS

_GLYPHS = {"good": "●", "usable": "▲", "refly": "■", "lost": "✕"}


def write_report(
    mission: Path,
    *,
    ledger: Mapping[str, Any] | None = None,
    geometry: Mapping[str, Any] | None = None,
) -> Path:
    """Write `report.html` into the mission's export folder.

    Args:
        mission: the mission folder.
        ledger: the balance sheet, where the service just told it.
        geometry: comparison with an emulator's truth, where there is one.

    Returns:
        The path of the report.
    """
    exposures = [_exposure(folder, mission) for folder in sorted((mission / "L0").glob("[0-9]*"))]
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined
    )
    html = environment.get_template("report.html").render(
        mission=mission.name,
        exposures=exposures,
        simulated=any(exposure["record"].get("simulated") for exposure in exposures),
        displaced=_displaced(exposures),
        tested=len(_figure(exposures, "displacement_test")),
        flight_says=write_displacements(mission)["sentences"],
        ledger=ledger,
        geometry=geometry,
        plots=[
            _plot("dC by cone, K", _temperature_series(exposures)),
            _plot("sigma0, px", {"sigma0": _figure(exposures, "sigma0_px")}),
            _plot("Sigma of the exposure's time, ns", {"sigma": _time_sigma(exposures)}),
        ],
        glyphs=_GLYPHS,
        time_parts=TIME_PARTS,
    )
    path = mission / "export" / "report.html"
    path.parent.mkdir(exist_ok=True)
    path.write_text(html, encoding="utf-8")
    return path


def _exposure(folder: Path, mission: Path) -> dict[str, Any]:
    level2 = mission / "L2" / folder.name
    record = _json(folder / "exposure.json")
    report = _json(level2 / "quality.json")
    residuals = level2 / "residuals.svg"
    quicklook = level2 / "quicklook.jpg"
    return {
        "number": int(folder.name),
        "record": record,
        "report": report,
        "verdict": report.get("verdict", record.get("state", "unknown")),
        "figures": report.get("figures", {}),
        "findings": report.get("findings", []),
        "gps": _gps_text(record.get("mark_gps_ns")),
        "worst_time_sigma_ns": _worst_time_sigma(record),
        "quicklook": _data_uri(quicklook, "image/jpeg"),
        "residuals": _data_uri(residuals, "image/svg+xml"),
    }


def _json(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    content = json.loads(path.read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else {}


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


def _worst_time_sigma(record: Mapping[str, Any]) -> int | None:
    sigmas = [frame.get("time_sigma_ns") for frame in record.get("frames", [])]
    return max((sigma for sigma in sigmas if sigma is not None), default=None)


def _displaced(exposures: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Which sensor was found displaced, in how many exposures, and by how much on average."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for exposure in exposures:
        name = exposure["figures"].get("displaced_sensor")
        probe = exposure["figures"].get("misread_probe")
        if name and probe:
            name = f"{name}, or probe {probe} misreads"
        if name:
            found.setdefault(name, []).append(exposure["figures"])
    return [
        {
            "sensor": name,
            "count": len(figures),
            "x_px": _mean(figures, "displacement_x_px"),
            "y_px": _mean(figures, "displacement_y_px"),
        }
        for name, figures in found.items()
    ]


def _mean(figures: Sequence[Mapping[str, Any]], key: str) -> float | None:
    values = [f[key] for f in figures if f.get(key) is not None]
    return sum(values) / len(values) if values else None


def _temperature_series(
    exposures: Sequence[Mapping[str, Any]],
) -> dict[str, list[tuple[int, float]]]:
    series: dict[str, list[tuple[int, float]]] = {}
    for exposure in exposures:
        for key, value in exposure["figures"].items():
            if key.startswith("dc_k_") and value is not None:
                series.setdefault(key.removeprefix("dc_k_"), []).append((exposure["number"], value))
    return series or {"mean": _figure(exposures, "dc_k")}


def _figure(exposures: Sequence[Mapping[str, Any]], key: str) -> list[tuple[int, float]]:
    return [
        (exposure["number"], exposure["figures"][key])
        for exposure in exposures
        if exposure["figures"].get(key) is not None
    ]


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
