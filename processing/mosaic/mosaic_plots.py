"""Plain SVG drawings: a rig's focal planes and virtual image, and what a stitching left over.

The drawings need no fonts or scripts; they are shown by a browser, in the report and by
`syntopic rigs show`. Sources of the pictures: Ladstädter et al. (2010), fig. 2 to 5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.placement import (
    SensorPlacement,
    nominal_placements,
    vip_mm_from_raw,
    vip_px_from_mm,
)
from processing.geometry.topology import Rectangle, corners, footprint, outline, overlaps
from processing.matching.tie_points import PAN_TO_COLOUR, PAN_TO_PAN, TiePoints
from processing.mosaic.free_mosaic import Mosaic
from processing.mosaic.residual_vectors import places_px
from processing.mosaic.validity import Validity
from processing.rig import Cone, Rig, VirtualImage

Array = NDArray[Any]

_INK: Final = "#1b2733"
_FAINT: Final = "#8a97a5"
_PAPER: Final = "#ffffff"
_PAN: Final = ("#2f6fb3", "#c4572b", "#2d8a57", "#8a4fa3", "#a88312", "#3d8f95")
_BAND: Final = {"red": "#c62f2f", "green": "#2c9440", "blue": "#2c57c4", "nir": "#7a3b73"}
_VECTOR: Final = "#1f5fa8"
_OUTLIER: Final = "#e08a00"
_DISPLACED: Final = "#c62f2f"
_MAX_VECTORS: Final = 2500
_RIGS: Final = 8
"""Whose outlines are kept."""


def focal_planes_svg(rig: Rig) -> str:
    """The focal plane of every cone, and below them the virtual image with its overlaps.

    The focal planes are looked at as the layers are: x right, y up in flight direction, mm. A rig
    without a virtual image has its focal planes only.

    Args:
        rig: the camera.

    Returns:
        Text of an SVG document.
    """
    columns = min(len(rig.cones), 4)
    cell, gap, top = 200.0, 20.0, 64.0
    reach = {
        role: max((_reach(cone) for cone in rig.cones if cone.role == role), default=1.0)
        for role in ("pan", "colour")
    }
    width = gap + columns * (cell + gap)
    body = [
        _text(gap, 28, f"{rig.name}: focal planes", 17, weight="bold"),
        _text(gap, 47, "layers in mm, x right, y up = flight direction; \u25b2 flight", 11, _FAINT),
    ]
    for k, cone in enumerate(rig.cones):
        x = gap + (k % columns) * (cell + gap)
        y = top + (k // columns) * (cell + gap + 16)
        body += _focal_plane(rig, cone, x, y, cell, reach[cone.role])
    height = top + math.ceil(len(rig.cones) / columns) * (cell + gap + 16)
    if rig.virtual_image is not None:
        drawn, used = _virtual_image(rig, rig.virtual_image, gap, height + 14, width - 2 * gap)
        body += drawn
        height += 14 + used
    return _svg(width, height + gap, body)


def residuals_svg(
    rig: Rig, tie_points: TiePoints, mosaic: Mosaic, validity: Validity | None = None
) -> str:
    """Residual vectors of P/P and P/C tie points, and of the master cone's sensors.

    Vectors are enlarged; the bar in each panel shows the scale. Points left out by data snooping
    are orange. At most a few thousand vectors are drawn, evenly thinned.

    Args:
        rig: the camera.
        tie_points: those the mosaic is of.
        mosaic: the adjustment.
        validity: its test; None or one without residuals leaves out the panel of the master cone.

    Returns:
        Text of an SVG document.

    Raises:
        ValueError: the rig has no virtual image.
    """
    image = rig.virtual_image
    if image is None:
        raise ValueError(f"rig {rig.name} has no virtual image to draw residuals in")
    gap, panel = 20.0, 520.0
    scale = panel / image.width_px
    height = image.height_px * scale
    body = [
        _text(gap, 28, f"{rig.name}: residuals of the {mosaic.method} mosaic", 17, weight="bold"),
        _text(
            gap,
            47,
            f"sigma0 {mosaic.sigma0_px:.4f} px = {mosaic.sigma0_um:.3f} um, "
            f"redundancy {mosaic.redundancy:.0f}, {int(mosaic.outliers.sum())} points left out",
            11,
            _FAINT,
        ),
    ]
    y = 84.0
    panels = ((PAN_TO_PAN, "P/P tie points"), (PAN_TO_COLOUR, "P/C tie points"))
    for k, (kind, title) in enumerate(panels):
        frame = (gap + k * (panel + gap), y, scale)
        rows = np.flatnonzero(tie_points.kind == kind)
        body += _vector_panel(rig, image, frame, title, tie_points, mosaic, rows)
    if validity is not None and validity.residuals:
        body += _master_panel(rig, image, (gap + 2 * (panel + gap), y, scale), validity)
        count = 3
    else:
        count = 2
    return _svg(gap + count * (panel + gap), y + height + 44.0, body)


def _reach(cone: Cone) -> float:
    """Largest distance of a sensor's edge from the principal point along an axis, mm."""
    return max(
        max(
            abs(s.x_mm) + s.width_px * s.pitch_mm / 2.0,
            abs(s.y_mm) + s.height_px * s.pitch_mm / 2.0,
        )
        for s in cone.sensors
    )


def _focal_plane(rig: Rig, cone: Cone, x: float, y: float, cell: float, reach: float) -> list[str]:
    colour = _colour(rig, cone)
    unit = cell / (2.0 * reach * 1.06)
    cx, cy = x + cell / 2.0, y + 16.0 + cell / 2.0
    marks = " master" if cone.name == rig.master_cone else ""
    marks += " colour master" if cone.name == rig.colour_master_cone else ""
    parts = [
        _text(x, y + 9, f"cone {cone.name}{marks}", 12, weight="bold"),
        _rect(x, y + 16, cell, cell, fill="#f6f8fa", stroke="#d5dce3"),
        _text(x + cell - 6, y + 28, f"f {cone.lens.f_mm:.1f} mm", 10, _FAINT, anchor="end"),
        _line(cx, y + 16, cx, y + 16 + cell, "#d5dce3"),
        _line(x, cy, x + cell, cy, "#d5dce3"),
        _text(cx + 4, y + 28, "\u25b2", 9, _FAINT),
    ]
    for sensor in cone.sensors:
        w, h = sensor.width_px * sensor.pitch_mm * unit, sensor.height_px * sensor.pitch_mm * unit
        sx, sy = cx + sensor.x_mm * unit, cy - sensor.y_mm * unit
        rotation_attribute = f"rotate({-math.degrees(sensor.rotation_rad):.4f} {sx:.2f} {sy:.2f})"
        parts += [
            _rect(
                sx - w / 2,
                sy - h / 2,
                w,
                h,
                fill=colour,
                stroke=colour,
                opacity=0.22,
                more=rotation_attribute,
            ),
            _text(sx, sy + 1, sensor.name, 12, colour, anchor="middle", weight="bold"),
            _text(
                sx,
                sy + 14,
                f"{sensor.x_mm:+.3f} {sensor.y_mm:+.3f}",
                8,
                _INK,
                anchor="middle",
            ),
        ]
    return parts


def _virtual_image(
    rig: Rig, image: VirtualImage, x: float, y: float, width: float
) -> tuple[list[str], float]:
    places = nominal_placements(rig, {}, {})
    seen = {name: vip_px_from_mm(image, outline(place)) for name, place in places.items()}
    drawn = [*rig.pan_cones, *(c for c in rig.colour_cones if c.name == rig.colour_master_cone)]
    corners_px = np.concatenate([seen[s.name] for cone in drawn for s in cone.sensors])
    size = np.array([image.width_px, image.height_px])
    # What looks past the image is shown, too; labels stand above.
    past = np.maximum(-corners_px.min(axis=0), corners_px.max(axis=0) - size)
    margin_x, margin_y = np.maximum(0.04 * image.width_px, past + 0.02 * image.width_px)
    unit = width / (image.width_px + 2.0 * margin_x)
    ox, oy = x + margin_x * unit, y + 30.0 + margin_y * unit
    height = (image.height_px + 2.0 * margin_y) * unit
    parts = [
        _text(x, y + 4, "virtual image", 17, weight="bold"),
        _text(
            x,
            y + 21,
            f"{image.width_px} x {image.height_px} px of {image.pitch_um:g} um, "
            f"f {image.f_mm:g} mm, colour 1:{image.colour_ratio}; overlaps in px",
            11,
            _FAINT,
        ),
    ]

    def box(r: Rectangle) -> tuple[float, float, float, float]:
        px = vip_px_from_mm(image, np.array([[r.x_min_mm, r.y_max_mm], [r.x_max_mm, r.y_min_mm]]))
        (left, upper), (right, lower) = (px + 0.5) * unit
        return ox + left, oy + upper, right - left, lower - upper

    for cone in rig.colour_cones:
        if cone.name == rig.colour_master_cone:
            bx, by, bw, bh = box(footprint(places[cone.sensors[0].name]))
            parts.append(
                _rect(bx, by, bw, bh, fill="none", stroke=_colour(rig, cone), dash="6 4", wide=1.4)
            )
            label = f"{cone.sensors[0].name} (colour master)"
            parts.append(_text(bx + bw - 6, by - 3, label, 10, _colour(rig, cone), anchor="end"))
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            bx, by, bw, bh = box(footprint(places[sensor.name]))
            colour = _colour(rig, cone)
            corner_points = " ".join(
                f"{ox + c * unit:.1f},{oy + r * unit:.1f}" for c, r in seen[sensor.name] + 0.5
            )
            parts.append(
                f'<polygon points="{corner_points}" fill="{colour}" fill-opacity="0.16" '
                f'stroke="{colour}"/>'
            )
            middle = (bx + bw / 2, by + bh / 2)
            parts.append(_text(*middle, sensor.name, 15, colour, anchor="middle", weight="bold"))
            parts.append(
                _text(middle[0], middle[1] + 15, f"cone {cone.name}", 10, _FAINT, anchor="middle")
            )
    for overlap in overlaps(rig):
        parts += _overlap_label(image, overlap.rectangle, box(overlap.rectangle))
    for corner in corners(rig):
        bx, by, bw, bh = box(corner.rectangle)
        parts.append(_rect(bx, by, bw, bh, fill=_INK, stroke=_INK, opacity=0.30))
    parts.append(
        _rect(
            ox,
            oy,
            image.width_px * unit,
            image.height_px * unit,
            fill="none",
            stroke=_INK,
            wide=1.6,
        )
    )
    return parts, 30.0 + height


def _overlap_label(
    image: VirtualImage, rectangle: Rectangle, box: tuple[float, float, float, float]
) -> list[str]:
    bx, by, bw, bh = box
    across = round(rectangle.width_mm / image.pitch_mm)
    along = round(rectangle.height_mm / image.pitch_mm)
    label = f"{across} x {along}"
    mx, my = bx + bw / 2, by + bh / 2
    rotation_attribute = f"rotate(-90 {mx:.1f} {my:.1f})" if bh > bw else ""
    return [
        _rect(bx, by, bw, bh, fill=_INK, stroke="none", opacity=0.10),
        _text(mx, my + 3.5, label, 10, _INK, anchor="middle", more=rotation_attribute),
    ]


def _vector_panel(
    rig: Rig,
    image: VirtualImage,
    frame: tuple[float, float, float],
    title: str,
    tie_points: TiePoints,
    mosaic: Mosaic,
    rows: NDArray[np.int64],
) -> list[str]:
    """The panel of the tie points `rows`."""
    x, y, scale = frame
    width, height = image.width_px * scale, image.height_px * scale
    residuals, outliers = mosaic.residuals_px[rows], mosaic.outliers[rows]
    parts = [*_outline(rig, image, frame)]
    known = np.isfinite(residuals).all(axis=1)
    used = known & ~outliers
    lengths = np.hypot(residuals[used, 0], residuals[used, 1])
    rms = float(np.sqrt(np.mean(lengths**2))) if len(lengths) else 0.0
    parts.append(_text(x, y - 8, f"{title}: {len(lengths)} used, rms {rms:.3f} px", 13, _INK))
    enlarge = 14.0 / max(float(np.percentile(lengths, 90)), 1e-6) if len(lengths) else 1.0
    step = max(1, math.ceil(int(known.sum()) / _MAX_VECTORS))
    for colour, of_colour in ((_VECTOR, used), (_OUTLIER, known & outliers)):
        chosen = np.flatnonzero(of_colour)[:: step if colour == _VECTOR else 1][:_MAX_VECTORS]
        ends = np.clip(residuals[chosen] * enlarge, -60.0, 60.0)
        at = (places_px(image, tie_points, mosaic, rows[chosen]) + 0.5) * scale
        numbers = np.column_stack([at, ends[:, 0], -ends[:, 1]]).ravel().tolist()
        # One format for all of them: thousands of short ones take several times as long.
        path = " ".join(["M%.1f %.1fl%.1f %.1f"] * len(chosen)) % tuple(numbers)
        if path:
            parts.append(
                f'<svg x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}">'
                f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="0.9" '
                'stroke-linecap="round"/></svg>'
            )
    parts += _bar(x, y + height + 20, enlarge, width)
    left_out = int((known & outliers).sum())
    if left_out:
        note = f"{left_out} left out"
        parts.append(_text(x + width, y + height + 24, note, 11, _OUTLIER, anchor="end"))
    return parts


def _master_panel(
    rig: Rig, image: VirtualImage, frame: tuple[float, float, float], validity: Validity
) -> list[str]:
    x, y, scale = frame
    width, height = image.width_px * scale, image.height_px * scale
    found = validity.displaced
    displaced = found.sensor if found else None
    title = "master cone against calibration: no sensor displaced"
    if found:
        title = f"master cone: {displaced} displaced by {found.dx_px:+.3f} {found.dy_px:+.3f} px"
    if validity.probe_bias:
        probe = f"probe {validity.probe_bias.probe} {validity.probe_bias.bias_k:+.1f} K off"
        title = f"{title}, or {probe}" if found else f"master cone: {probe}, no sensor displaced"
    parts = [
        *_outline(rig, image, frame),
        _text(x, y - 8, title, 13, _DISPLACED if displaced else _INK),
    ]
    longest = max(math.hypot(r.dx_px, r.dy_px) for r in validity.residuals)
    enlarge = 70.0 / max(longest, 3.0 * max(r.sigma_x_px for r in validity.residuals), 1e-6)
    places = _calibrated(rig)
    for residual in validity.residuals:
        sensor = places[residual.sensor].sensor
        middle = np.array([[(sensor.width_px - 1) / 2.0, (sensor.height_px - 1) / 2.0]])
        at = vip_px_from_mm(image, vip_mm_from_raw(places[residual.sensor], middle))[0]
        cx, cy = x + at[0] * scale, y + at[1] * scale
        ex, ey = cx + residual.dx_px * enlarge, cy - residual.dy_px * enlarge
        colour = _DISPLACED if residual.sensor == displaced else _VECTOR
        parts += [
            f'<ellipse cx="{cx:.1f}" cy="{cy:.1f}" rx="{3 * residual.sigma_x_px * enlarge:.1f}" '
            f'ry="{3 * residual.sigma_y_px * enlarge:.1f}" fill="{colour}" fill-opacity="0.13" '
            f'stroke="{colour}" stroke-dasharray="3 2"/>',
            _line(cx, cy, ex, ey, colour, wide=2.2),
            f'<circle cx="{ex:.1f}" cy="{ey:.1f}" r="3" fill="{colour}"/>',
            _text(
                cx,
                cy + 62,
                f"{residual.sensor} {residual.dx_px:+.3f} {residual.dy_px:+.3f} px",
                11,
                colour,
                anchor="middle",
            ),
        ]
    note = "dashed: three standard deviations"
    parts.append(_text(x + width, y + height + 24, note, 11, _FAINT, anchor="end"))
    return parts + _bar(x, y + height + 20, enlarge, width)


def _outline(rig: Rig, image: VirtualImage, frame: tuple[float, float, float]) -> list[str]:
    """The virtual image with the footprints of its PAN sensors."""
    x, y, scale = frame
    parts = [
        _rect(x, y, image.width_px * scale, image.height_px * scale, fill="#f6f8fa", stroke=_INK)
    ]
    for ends in _footprints_px(rig, image):
        (left, upper), (right, lower) = np.clip(
            (ends + 0.5) * scale, 0.0, [image.width_px * scale, image.height_px * scale]
        ).tolist()
        parts.append(
            _rect(x + left, y + upper, right - left, lower - upper, fill="none", stroke="#cfd7df")
        )
    return parts


@lru_cache(maxsize=_RIGS)
def _calibrated(rig: Rig) -> Mapping[str, SensorPlacement]:
    """Placements by calibration alone, which all exposures share."""
    return nominal_placements(rig, {}, {})


@lru_cache(maxsize=_RIGS)
def _footprints_px(rig: Rig, image: VirtualImage) -> tuple[Array, ...]:
    """Upper left and lower right corner (2, 2) of every PAN sensor in the virtual image, px."""
    boxes = [footprint(_calibrated(rig)[s.name]) for cone in rig.pan_cones for s in cone.sensors]
    return tuple(
        vip_px_from_mm(image, np.array([[r.x_min_mm, r.y_max_mm], [r.x_max_mm, r.y_min_mm]]))
        for r in boxes
    )


def _bar(x: float, y: float, enlarge: float, width: float) -> list[str]:
    """A bar of a round length in px, at most a quarter of the panel."""
    length = 10.0 ** math.floor(math.log10(max(0.25 * width / enlarge, 1e-9)))
    for factor in (5.0, 2.0):
        if length * factor * enlarge <= 0.25 * width:
            length *= factor
            break
    end = x + length * enlarge
    return [
        _line(x, y, end, y, _INK, wide=1.6),
        _line(x, y - 4, x, y + 4, _INK, wide=1.6),
        _line(end, y - 4, end, y + 4, _INK, wide=1.6),
        _text(end + 8, y + 4, f"{length:g} px", 11),
    ]


def _colour(rig: Rig, cone: Cone) -> str:
    if cone.role == "colour":
        return _BAND.get(cone.bands[0] if len(cone.bands) == 1 else "green", _INK)
    return _PAN[[c.name for c in rig.pan_cones].index(cone.name) % len(_PAN)]


def _svg(width: float, height: float, body: Iterable[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" '
        'font-family="system-ui, DejaVu Sans, Helvetica, Arial, sans-serif">'
        f'<rect width="100%" height="100%" fill="{_PAPER}"/>' + "".join(body) + "</svg>"
    )


def _text(
    x: float,
    y: float,
    content: str,
    size: float,
    fill: str = _INK,
    *,
    anchor: str = "start",
    weight: str = "normal",
    more: str = "",
) -> str:
    rotation_attribute = f' transform="{more}"' if more else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{fill}" '
        f'text-anchor="{anchor}" font-weight="{weight}"{rotation_attribute}>'
        f"{escape(content)}</text>"
    )


def _rect(
    x: float,
    y: float,
    width: float,
    height: float,
    *,
    fill: str,
    stroke: str,
    opacity: float = 1.0,
    dash: str = "",
    wide: float = 1.0,
    more: str = "",
) -> str:
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    rotation_attribute = f' transform="{more}"' if more else ""
    return (
        f'<rect x="{x:.2f}" y="{y:.2f}" width="{width:.2f}" height="{height:.2f}" fill="{fill}" '
        f'fill-opacity="{opacity:g}" stroke="{stroke}" stroke-width="{wide:g}"{dashed}'
        f"{rotation_attribute}/>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, stroke: str, *, wide: float = 1.0) -> str:
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{stroke}" '
        f'stroke-width="{wide:g}"/>'
    )
