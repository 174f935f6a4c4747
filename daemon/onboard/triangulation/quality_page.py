"""The quality report of a live triangulation: one page of HTML without scripts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Final

import numpy as np

from daemon.orientation.geodesy import metres_per_degree

_STYLE: Final = (
    "body{font:15px/1.4 sans-serif;max-width:52rem;margin:2rem auto;padding:0 1rem}"
    "table{border-collapse:collapse}td,th{padding:.15rem .8rem .15rem 0;text-align:left}"
    "td.n{text-align:right;font-variant-numeric:tabular-nums}.bad{color:#a00}"
)
_WIDTH_PX: Final = 520.0
_COLOURS: Final = {"block": "#2a7", "window": "#c90", "measured": "#c22"}


def quality_page(content: Mapping[str, Any]) -> str:
    """The page of `live.json`."""
    state = "Preliminary: the flight goes on." if content["is_preliminary"] else "After landing."
    sigma0 = "" if content["sigma0"] is None else f", sigma0 {content['sigma0']:.2f}"
    parts = [
        f"<h1>Triangulation of {escape(content['mission'])}</h1>",
        f"<p>{state} {content['exposures']} exposures of {len(content['lines'])} lines, "
        f"{content['adjusted']} in the last adjustment{sigma0}."
        f"{' Simulated.' if content['simulated'] else ''}</p>",
        _accuracy(content),
        _coverage(content.get("coverage")),
        _control(content.get("control")),
        "<h2>Findings</h2>",
        _list(f"<b>{escape(f['name'])}</b>: {escape(f['sentence'])}" for f in content["findings"]),
        "<h2>To fly again, by the tie points</h2>",
        _list(_advice(one) for one in content["reflights"]),
        "<h2>Against the calibration</h2>",
        _drifts(content["drifts"]),
        "<h2>Exposures</h2>",
        _drawing(content["orientations"]),
    ]
    body = "\n".join(parts)
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>Triangulation of {escape(content['mission'])}</title><style>{_STYLE}</style>"
        f"<body>{body}</body></html>\n"
    )


def _accuracy(content: Mapping[str, Any]) -> str:
    found = content["accuracy"]
    if found is None:
        return '<p class="bad">No accuracy: no block was adjusted.</p>'
    px = content["image_sigma_px"]
    return (
        "<h2>Expected accuracy without control points</h2><table>"
        "<tr><th></th><th>median</th><th>95 %</th></tr>"
        f'<tr><td>Plan</td><td class="n">{found["plan_m"]:.3f} m</td>'
        f'<td class="n">{found["plan_95_m"]:.3f} m</td></tr>'
        f'<tr><td>Height</td><td class="n">{found["height_m"]:.3f} m</td>'
        f'<td class="n">{found["height_95_m"]:.3f} m</td></tr></table>'
        f"<p>{found['points']} tie points; image coordinates {px[0]:.3f} and {px[1]:.3f} px. "
        "Standard deviations by the adjustment; no point on the ground was measured.</p>"
    )


def _coverage(areas: Mapping[str, Any] | None) -> str:
    """Areas by number of images."""
    if areas is None:
        return ""
    once, twice, thrice = (
        f"{areas[key] / 1e6:.3f} km²" for key in ("once_m2", "twice_m2", "thrice_m2")
    )
    left_out = areas["left_out"]
    note = f" {left_out} images that look near the horizon do not count." if left_out else ""
    return (
        f"<h2>Coverage</h2><p>{once}; by two or more images {twice}, by three or more {thrice}. "
        f"By the orientations above and the height of the tie points.{note}</p>"
    )


def _control(control: Mapping[str, Any] | None) -> str:
    """Residuals at control and check points; nothing where none were given."""
    if control is None:
        return ""
    rows = "".join(_residual(one) for one in control["residuals"] or ())
    total = [_length(value) for value in control["rms_m"]]
    expected = [_length(value) for value in control["expected_m"]]
    px = "" if control["rms_px"] is None else f" Image residuals {control['rms_px']:.2f} px RMS."
    return (
        "<h2>Control and check points, block minus survey</h2>"
        f"<p>{control['points']} points, none of them in the adjustment. East, north, height RMS "
        f"{', '.join(total)}; expected {', '.join(expected)}.{px} Without image coordinates only "
        "heights are compared, with the surface of the tie points.</p>"
        "<table><tr><th>Point</th><th>East</th><th>North</th><th>Height</th><th></th></tr>"
        f"{rows}</table>"
    )


def _residual(one: Mapping[str, Any]) -> str:
    cells = "".join(f'<td class="n">{_length(value)}</td>' for value in one["difference_m"])
    note = one["reason"] or (
        f"{one['rays']} images" if one["rays"] else f"{one['ties']} tie points"
    )
    name = f"{escape(one['name'])}, {escape(one['role'])}"
    return f"<tr><td>{name}</td>{cells}<td>{escape(note)}</td></tr>"


def _length(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} m"


def _drifts(drifts: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for one in drifts:
        if one["value"] is None:
            cells = '<td class="n"></td><td>not determined by this flight</td>'
        else:
            note = "" if one["determined"] else " (not determined by this flight)"
            cells = (
                f'<td class="n">{one["value"]:.4g} {escape(one["unit"])}</td>'
                f"<td>sigma {one['sigma']:.3g}{note}</td>"
            )
        rows.append(f"<tr><td>{escape(one['name'])}</td>{cells}</tr>")
    return f"<table>{''.join(rows)}</table>" if rows else "<p>None: no block was adjusted.</p>"


def _advice(one: Mapping[str, Any]) -> str:
    if one["kind"] == "cross line":
        return escape(f"A cross line over {' and '.join(one['lines'])}: {one['reason']}.")
    line = f"line {one['line']}, " if one["line"] else ""
    span = f"{one['from']}" if one["from"] == one["to"] else f"{one['from']} to {one['to']}"
    return escape(f"{line}exposures {span}: {one['reason']}.")


def _list(items: Iterable[str]) -> str:
    own = "".join(f"<li>{item}</li>" for item in items)
    return f"<ul>{own}</ul>" if own else "<p>None.</p>"


def _drawing(orientations: Sequence[Mapping[str, Any]]) -> str:
    """Projection centres by source, north up."""
    if not orientations:
        return "<p>None.</p>"
    place = np.array([[o["latitude_deg"], o["longitude_deg"]] for o in orientations])
    per_latitude, per_longitude = metres_per_degree(float(place[:, 0].mean()), 0.0)
    east = (place[:, 1] - place[:, 1].min()) * per_longitude
    north = (place[:, 0] - place[:, 0].min()) * per_latitude
    scale = _WIDTH_PX / max(float(east.max()), float(north.max()), 1.0)
    height = float(north.max()) * scale + 20.0
    dots = "".join(
        f'<circle cx="{10 + x * scale:.1f}" cy="{height - 10 - y * scale:.1f}" r="3" '
        f'fill="{_COLOURS[o["source"]]}"><title>{o["exposure"]}</title></circle>'
        for o, x, y in zip(orientations, east, north, strict=True)
    )
    width = float(east.max()) * scale + 20.0
    return (
        f'<svg width="{width:.0f}" height="{height:.0f}" role="img" '
        f'aria-label="Exposures by source of their orientation">{dots}</svg>'
        "<p>Green: adjusted in the block; amber: in its window; red: measured only.</p>"
    )
