"""An adjusted project as files of another program, with its image measurements."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from daemon.mission.store.direct_io import create_file
from daemon.mission.store.durable import make_directories
from daemon.mission.store.publication import published
from daemon.postflight.exchange.adjusted_block import block_of_project
from daemon.postflight.exchange.block import Block, BlockError
from daemon.postflight.exchange.colmap import colmap_texts
from daemon.postflight.exchange.measured_texts import (
    MEASURED_PROGRAMS,
    measured_texts,
    what_to_know,
)
from daemon.postflight.exchange.opensfm import reconstruction_of
from daemon.postflight.exchange.opensfm_tracks import TRACKS_FILE
from daemon.postflight.exchange.photogrammetry import Angles, Unit

PROGRAMS: Final = ("colmap", "opensfm", *MEASURED_PROGRAMS)


@dataclass(frozen=True)
class ExportedProject:
    """The block that was written, sigma0 of its adjustment, and residuals of cameras, px.

    `notes` state what differs in the files from the project.
    """

    block: Block
    sigma0: float
    residuals_px: Mapping[str, float]
    notes: tuple[str, ...] = ()


def export_project(
    path: Path,
    program: str,
    out: Path,
    *,
    angles: Angles | None = None,
    unit: Unit | None = None,
) -> ExportedProject:
    """Adjust a project, and write cameras, orientations, points and measurements.

    Args:
        path: project.toml, or its folder.
        program: of `PROGRAMS`.
        out: new folder.
        angles: order of angles for BINGO; None is its own.
        unit: of these angles; None is its own.

    Raises:
        ProjectError: the project cannot be read.
        BlockError: it cannot be exported, or `out` is there.
        OSError: the disk refused.
    """
    if out.exists():
        raise BlockError(f"{out}: is there already; give a new folder with --out")
    if program not in MEASURED_PROGRAMS and (angles is not None or unit is not None):
        raise BlockError(f"{program} has no angles; leave --angles and --unit out")
    has_distortion = program not in MEASURED_PROGRAMS or program == "pix4d"
    block, sigma0 = block_of_project(path, without_distortion=not has_distortion)
    notes = block.notes
    if program in MEASURED_PROGRAMS:
        texts, residuals = measured_texts(program, block, angles, unit)
        notes = what_to_know(program, block)
    elif program == "colmap":
        texts, residuals = colmap_texts(block, None)
    else:
        reconstruction, residuals = reconstruction_of(block)
        reconstruction["points"] = {
            name: {"coordinates": xyz, "color": [128, 128, 128]}
            for name, xyz in zip(block.points.names, block.points.xyz_m.tolist(), strict=True)
        }
        texts = {
            "reconstruction.json": json.dumps([reconstruction], indent=1) + "\n",
            TRACKS_FILE: tracks_text(block),
        }
    make_directories(out.resolve().parent)
    with published(out) as part:
        for name, text in texts.items():
            create_file(part / name, [text.encode("utf-8")], mode=0o644)
    return ExportedProject(block, sigma0, residuals, notes)


def tracks_text(block: Block) -> str:
    """OpenSfM's `tracks.csv`, version 2: shares of the longer side about the middle."""
    points = block.points
    cameras = [block.cameras[image.camera] for image in block.images]
    size = np.array([(camera.width_px, camera.height_px) for camera in cameras], float)
    of = points.image
    places = (points.px - (size[of] - 1.0) / 2.0) / size[of].max(axis=1, keepdims=True)
    seen = [0] * len(block.images)
    rows = ["OPENSFM_TRACKS_VERSION_v2"]
    for image, point, (x, y) in zip(
        of.tolist(), points.point.tolist(), places.tolist(), strict=True
    ):
        name, track = block.images[image].name, points.names[point]
        rows.append(f"{name}\t{track}\t{seen[image]}\t{x!r}\t{y!r}\t0.001\t128\t128\t128\t-1\t-1")
        seen[image] += 1
    return "\n".join(rows) + "\n"
