"""Peers of the pipeline: a bare cv2.remap with our maps, and nona + enblend on the same frames.

Only timed here; nothing of what they make is used.
"""

from __future__ import annotations

import math
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from processing.geometry.placement import SensorPlacement
from processing.image.lattice import OUTSIDE, fill_lattice, lattice_shape, pan_raster
from processing.matching.tie_points import PAN_TO_PAN, TiePoints
from processing.rig import Rig

CELL_PX = 32
REMAP_THREADS = 2
REMAP_RUNS = 5
PEER_TIMEOUT_S = 1500.0
PACKAGES = {
    "nona": "hugin-tools",
    "pano_trafo": "hugin-tools",
    "autooptimiser": "hugin-tools",
    "enblend": "enblend",
}
CONTROL_POINTS = 100
GEOMETRY_POINTS = 5000
"""Points of each sensor that are located in the panorama."""


class PeerError(DaemonError):
    """A peer program that did not do its work."""


def missing_programs() -> str | None:
    """A sentence that names the Debian packages of peers that are not installed; None: all are."""
    absent = [f"{name} (Debian package {p})" for name, p in PACKAGES.items() if not _found(name)]
    return f"not installed: {', '.join(absent)}" if absent else None


def remap_seconds(
    rig: Rig,
    placements: Mapping[str, SensorPlacement],
    frames: Mapping[str, NDArray[np.uint16]],
) -> float:
    """Seconds of cv2.remap, cubic, of all PAN frames, each over the box of the image it fills.

    The reference of the pipeline's pace, whatever its own threads: two threads, float32 maps, made
    before and not timed, one warm-up, median of five runs. Nothing is blended, masked or balanced.
    """
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(REMAP_THREADS)
    runs = [0.0] * REMAP_RUNS
    try:
        for name, frame in frames.items():
            remap = remap_of(rig, placements[name], frame)
            remap()
            for k in range(REMAP_RUNS):
                started = time.perf_counter()
                remap()
                runs[k] += time.perf_counter() - started
    finally:
        cv2.setNumThreads(threads)
    return statistics.median(runs)


def remap_of(
    rig: Rig, placement: SensorPlacement, frame: NDArray[np.uint16]
) -> Callable[[], object]:
    """One bare cv2.remap of a PAN frame over the box of the image it fills, its maps made."""
    import cv2

    image = rig.virtual_image
    if image is None:
        raise PeerError(f"rig {rig.name} has no virtual image to remap to")
    raster = pan_raster(image)
    rows, columns = lattice_shape(raster, CELL_PX)
    lattice = np.empty((rows, columns, 2))
    fill_lattice(image, raster, placement, CELL_PX, lattice)
    height, width = frame.shape
    c, r = lattice[..., 0], lattice[..., 1]
    inside = (c >= 0) & (c <= width - 1) & (r >= 0) & (r <= height - 1)
    i, j = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    box = lattice[i[0] : i[-1] + 1, j[0] : j[-1] + 1]
    box = np.where(box == OUTSIDE, 0.0, box)
    up, along = _between(box.shape[0]), _between(box.shape[1])
    maps = [np.ascontiguousarray(up @ box[..., k] @ along.T, np.float32) for k in (0, 1)]
    source = np.ascontiguousarray(frame)
    target = np.zeros(maps[0].shape, np.uint16)
    return partial(
        cv2.remap, source, maps[0], maps[1], cv2.INTER_CUBIC, target, cv2.BORDER_CONSTANT
    )


def _between(nodes: int) -> NDArray[np.float32]:
    """Linear interpolation from nodes to the pixels between them, (pixels, nodes)."""
    at = np.arange((nodes - 1) * CELL_PX) / CELL_PX
    node = at.astype(np.intp)
    matrix = np.zeros((len(at), nodes), np.float32)
    matrix[np.arange(len(at)), node] = 1.0 - (at - node)
    matrix[np.arange(len(at)), node + 1] = at - node
    return matrix


def nona_enblend_seconds(rig: Rig, level0: Path) -> dict[str, Any]:
    """Seconds of nona and enblend for the PAN image from Level-0, sensors placed as calibrated.

    They know no temperature, no radiometry and no lens of ours; lens and shifts are given as a
    rectilinear camera with shifted centres.
    """
    with tempfile.TemporaryDirectory(prefix="syntopic-peer-") as scratch:
        project = Path(scratch) / "image.pto"
        project.write_text(project_of(rig, level0), encoding="utf-8")
        begun = time.perf_counter()
        _run(["nona", "-o", str(Path(scratch) / "part"), str(project)])
        middle = time.perf_counter()
        parts = sorted(str(path) for path in Path(scratch).glob("part*.tif"))
        _run(["enblend", "-o", str(Path(scratch) / "whole.tif"), *parts])
        ended = time.perf_counter()
    return {"seconds": ended - begun, "nona_s": middle - begun, "enblend_s": ended - middle}


def nona_geometry(
    rig: Rig,
    level0: Path,
    geometry: Mapping[str, NDArray[Any]],
    tie_points: TiePoints | None = None,
) -> dict[str, NDArray[Any]]:
    """Where nona fetches the pixels of the virtual image: a table as in geometry.npz.

    Asked of pano_trafo, which is the same mapping, at points of our own table; which sensor serves
    a pixel is taken from there too, so that the same pixels are compared.

    Args:
        geometry: `<sensor>.vip`, `<sensor>.raw`, `<sensor>.weight` of our pipeline.
        tie_points: of the exposure; the peer's own optimiser (autooptimiser) then finds shift,
            rotation and scale of every frame but the first from them. None: as calibrated.
    """
    table: dict[str, NDArray[Any]] = {}
    with tempfile.TemporaryDirectory(prefix="syntopic-peer-") as scratch:
        project = Path(scratch) / "image.pto"
        text = project_of(rig, level0)
        if tie_points is not None:
            text += _control_points(rig, tie_points)
        project.write_text(text, encoding="utf-8")
        if tie_points is not None:
            _run(["autooptimiser", "-n", "-o", str(project), str(project)])
        names = [sensor.name for cone in rig.pan_cones for sensor in cone.sensors]
        for number, name in enumerate(names):
            if f"{name}.vip" not in geometry:
                continue
            step = max(len(geometry[f"{name}.vip"]) // GEOMETRY_POINTS, 1)
            vip = geometry[f"{name}.vip"][::step]
            stdin_text = "".join(f"{column} {row}\n" for column, row in vip)
            output = _run(["pano_trafo", "-r", str(project), str(number)], stdin_text)
            raw = np.array([line.split() for line in output.splitlines() if line.strip()], float)
            if raw.shape != vip.shape:
                raise PeerError(f"pano_trafo gave {len(raw)} of {len(vip)} points of {name}")
            table |= {f"{name}.vip": vip, f"{name}.raw": raw}
            table[f"{name}.weight"] = geometry[f"{name}.weight"][::step]
    return table


def project_of(rig: Rig, level0: Path) -> str:
    """The project file of Hugin: each PAN frame a rectilinear image with a shifted centre."""
    image = rig.virtual_image
    if image is None:
        raise PeerError(f"rig {rig.name} has no virtual image to stitch")
    field = _degrees(image.width_px * image.pitch_mm, image.f_mm)
    lines = [f'p f0 w{image.width_px} h{image.height_px} v{field} n"TIFF_m c:NONE"', "m i0"]
    for cone in rig.pan_cones:
        for sensor in cone.sensors:
            width = sensor.width_px * sensor.pitch_mm
            d, e = -sensor.x_mm / sensor.pitch_mm, sensor.y_mm / sensor.pitch_mm
            path = (level0 / f"{sensor.name}.tif").resolve()
            lines.append(
                f"i w{sensor.width_px} h{sensor.height_px} f0 "
                f"v{_degrees(width, cone.lens.f_mm)} r0 p0 y0 a0 b0 c0 d{d:.4f} e{e:.4f} "
                f'Eev0 Er1 Eb1 Vm5 n"{path}"'
            )
    return "\n".join(lines) + "\n"


def _control_points(rig: Rig, tie_points: TiePoints) -> str:
    """Lines of the project: a hundred tie points of each PAN overlap, and what may be moved."""
    names = [sensor.name for cone in rig.pan_cones for sensor in cone.sensors]
    number = {tie_points.names.index(name): k for k, name in enumerate(names)}
    lines = []
    for overlap in range(len(tie_points.pairs)):
        rows = np.flatnonzero((tie_points.overlap == overlap) & (tie_points.kind == PAN_TO_PAN))
        for i in rows[:: max(len(rows) // CONTROL_POINTS, 1)]:
            a, b = tie_points.raw_a[i], tie_points.raw_b[i]
            lines.append(
                f"c n{number[int(tie_points.sensor_a[i])]} N{number[int(tie_points.sensor_b[i])]} "
                f"x{a[0]:.4f} y{a[1]:.4f} X{b[0]:.4f} Y{b[1]:.4f} t0"
            )
    lines += [f"v {what}{k}" for k in range(1, len(names)) for what in ("r", "d", "e", "v")]
    return "\n".join(lines) + "\n"


def _degrees(width_mm: float, f_mm: float) -> float:
    return math.degrees(2.0 * math.atan(width_mm / 2.0 / f_mm))


def _found(program: str) -> bool:
    return shutil.which(program) is not None


def _run(command: list[str], stdin_text: str | None = None) -> str:
    try:
        done = subprocess.run(
            command,
            input=stdin_text,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            check=True,
            timeout=PEER_TIMEOUT_S,
            text=True,
            errors="replace",
        )
    except subprocess.TimeoutExpired as error:
        raise PeerError(f"{command[0]} took longer than {PEER_TIMEOUT_S:.0f} s") from error
    except subprocess.CalledProcessError as error:
        last = error.stdout.strip().splitlines()[-1:]
        raise PeerError(f"{command[0]} failed: {last[0] if last else error.returncode}") from error
    return done.stdout
