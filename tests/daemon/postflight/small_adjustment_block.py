"""A small block written as an adjustment project, and changes of its tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner

from daemon.cli import app
from daemon.postflight.adjustment.contradictions import SUSPICIOUS_SIGMA0
from daemon.postflight.adjustment.project import CheckPoints
from daemon.postflight.adjustment.project_file import AdjustSection, CameraSection, ProjectFile
from daemon.postflight.adjustment.project_writer import write_project
from processing.bundle.network import Distances
from tests.processing.bundle.simulated_networks import aerial

Change = Callable[[str], str]


def write_small_block(folder: Path, seed: int = 3) -> Path:
    """Write a block of 8 images with GNSS positions and a distance."""
    simulated = aerial(seed=seed, sigma_mm=1e-3, points=40, gnss_sigma_m=0.05)
    length = float(np.linalg.norm(simulated.points[10] - simulated.points[11]))
    network = replace(
        simulated.network,
        distances=Distances(np.array([10]), np.array([11]), np.array([length]), np.array([0.01])),
    )
    file = ProjectFile(
        format=1,
        name="block",
        adjust=AdjustSection(),
        camera=(CameraSection(name="c", f_mm=70.0),),
    )
    nothing = np.zeros((0, 3))
    write_project(folder, file, network, CheckPoints((), nothing, nothing))
    return folder


def changed_cell(row: int, column: str, change: Change) -> Change:
    """Change a cell of a table; rows count from 0 after the names of columns, -1 is every row."""

    def changed(text: str) -> str:
        lines = text.splitlines()
        header = next(k for k, line in enumerate(lines) if not line.startswith("#"))
        at = lines[header].split(",").index(column)
        for k in range(header + 1, len(lines)):
            if row in (-1, k - header - 1):
                cells = lines[k].split(",")
                cells[at] = change(cells[at])
                lines[k] = ",".join(cells)
        return "\n".join(lines) + "\n"

    return changed


def adjusted_report(folder: Path, *options: str) -> dict[str, Any]:
    """Adjust a project; status 1 is right where sigma0 is beyond its limit, and only there."""
    outcome = CliRunner().invoke(app, ["adjust", str(folder), "--json", *options])
    assert outcome.exit_code in (0, 1), outcome.output
    content: dict[str, Any] = json.loads(outcome.stdout)
    assert outcome.exit_code == int(content["sigma0"] > SUSPICIOUS_SIGMA0), outcome.output
    return content
