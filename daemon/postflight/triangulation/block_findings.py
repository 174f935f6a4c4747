"""What is wrong with a triangulated block after landing, as in flight.

Names, limits and sentences are those of the triangulation in flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.layout import Mission
from daemon.onboard.triangulation.drifts import Drift, DriftInputs, drifts_of
from daemon.onboard.triangulation.findings import (
    BlockTies,
    TriangulationFinding,
    findings_of,
    left_out_exposures,
)
from daemon.onboard.triangulation.flown_plan import missing_at_ends
from daemon.onboard.triangulation.heading_check import headings_off
from daemon.onboard.triangulation.height_model_check import check_heights, read_relief
from daemon.orientation.exterior_orientation import mount_of
from daemon.planning.model import PlannedLine
from daemon.planning.plan_readers import read_plan
from daemon.postflight.triangulation.triangulation import ImageBlock, TriangulationSettings
from processing.bundle.adjust import Adjustment, adjust
from processing.bundle.block_adjustment import adjusted_mounting
from processing.bundle.camera_orientations import variance_factor
from processing.bundle.flown_network import MOUNTING
from processing.bundle.initial_values import completed
from processing.bundle.network import ImagePoints, NetworkError
from processing.bundle.rank_diagnosis import RankDefectError
from processing.matching.block_matching import BlockTiePoints

Array = NDArray[np.float64]


def findings_json(
    block: ImageBlock, tied: BlockTiePoints, result: Adjustment, settings: TriangulationSettings
) -> dict[str, Any]:
    """The keys `drifts` and `findings` of the report.

    Raises:
        ConfigurationError: the configuration of the flight cannot be used.
    """
    drifts = block_drifts(block, result, settings)
    found = block_findings(block, tied, result, drifts)
    return {
        "drifts": [one.as_json() for one in drifts],
        "findings": [one.as_json() for one in found],
    }


def block_findings(
    block: ImageBlock, tied: BlockTiePoints, result: Adjustment, drifts: tuple[Drift, ...]
) -> tuple[TriangulationFinding, ...]:
    """Everything that is wrong, the gravest first."""
    relief, heights = read_relief(mount_of(block.mission)[1])
    if relief is not None:
        good = ~result.left_out
        variance = np.einsum("pii->pi", result.point_cofactor[good])
        sigma = np.sqrt(variance_factor(result.sigma0) * np.clip(variance, 0.0, None))
        heights = check_heights(relief, block.frame, result.state.points[good], sigma)
    planned = _planned_lines(block.mission)
    return findings_of(
        block_ties(block, tied, result),
        drifts,
        skipped=block.skipped,
        planned_lines=[line.id for line in planned],
        missing_at_ends=missing_at_ends(
            planned,
            block.lines,
            np.array([(eo.latitude_deg, eo.longitude_deg) for eo in block.oriented]),
        ),
        heights=heights,
        has_landed=True,
    )


def block_drifts(
    block: ImageBlock, result: Adjustment, settings: TriangulationSettings
) -> tuple[Drift, ...]:
    """Corrections of the mounting, and functions of time and temperature."""
    arrangement = block.arrangement
    own = arrangement.first
    begun = block.oriented[0].gps_ns
    result = _with_all_navigation(result)
    time_s = np.array([block.oriented[k].gps_ns - begun for k in own]) * 1e-9
    lines = [block.oriented[k].line_id for k in own]
    is_one = [head.name for head in result.network.heads] == [MOUNTING]
    prior = settings.sigmas.prior
    return drifts_of(
        DriftInputs(
            result,
            adjusted_mounting(result, prior) if is_one else None,
            prior,
            time_s,
            _velocity(arrangement.position_m, lines, time_s),
            block.temperature_c[own],
            arrangement.position_m[:, 2] - block.ground_m,
        )
    )


def block_ties(block: ImageBlock, tied: BlockTiePoints, result: Adjustment) -> BlockTies:
    """How the images are tied; points are counted that the adjustment used."""
    lines = block.lines
    own = np.zeros((len(lines), 2), dtype=np.int64)
    pairs: dict[tuple[str, str], tuple[int, int]] = {}
    for (a, b), tried in tied.tried.items():
        counts = np.array([tried, tied.matched.get((a, b), 0)])
        if lines[a] == lines[b]:
            own[a] += counts
            own[b] += counts
            continue
        first, second = sorted((lines[a], lines[b]))
        before = pairs.get((first, second), (0, 0))
        pairs[first, second] = (before[0] + tried, before[1] + int(counts[1]))
    table = result.network.image_points
    used = (table.point < tied.points) & (result.weight > 0.0) & ~result.left_out[table.point]
    ties = np.bincount(table.image[used], minlength=len(lines))
    return BlockTies(
        tuple(eo.exposure for eo in block.oriented),
        lines,
        tuple(int(n) for n in ties),
        tuple((int(tried), int(found)) for tried, found in own),
        pairs,
        result.groups,
        (),
        *left_out_exposures(result, [block.oriented[k].exposure for k in block.arrangement.first]),
        headings_off_deg=_headings_off(block, lines),
    )


def _headings_off(block: ImageBlock, lines: tuple[str, ...]) -> tuple[float, ...]:
    """Of stitched images; heads look wherever they are mounted."""
    if not all(eo.is_virtual for eo in block.oriented):
        return ()
    time_s = np.array([eo.gps_ns - block.oriented[0].gps_ns for eo in block.oriented]) * 1e-9
    return tuple(headings_off(lines, time_s, block.station_m, block.rotation).tolist())


def _with_all_navigation(result: Adjustment) -> Adjustment:
    """The adjustment, again with the navigation that it left out: a drift looks like blunders."""
    excluded = result.excluded
    if not (excluded.attitude.any() or excluded.gnss.any()):
        return result
    table, keep = result.network.image_points, ~excluded.image
    network = replace(
        result.network,
        image_points=ImagePoints(
            table.image[keep], table.point[keep], table.xy_mm[keep], table.sigma_mm[keep]
        ),
    )
    settings = replace(result.settings, robust=False, reject_beyond=None)
    try:
        return adjust(completed(network), settings)
    except (NetworkError, RankDefectError):
        return result


def _velocity(position_m: Array, line_of: Sequence[str], time_s: Array) -> Array:
    """Velocities by the neighbours of each exposure in its line, (n, 3); NaN without any."""
    velocity = np.full((len(time_s), 3), np.nan)
    lines = np.array(line_of)
    for line in dict.fromkeys(line_of):
        own = np.flatnonzero(lines == line)
        own = own[np.argsort(time_s[own], kind="stable")]
        if len(own) > 1 and (np.diff(time_s[own]) > 0.0).all():
            velocity[own] = np.gradient(position_m[own], time_s[own], axis=0)
    return velocity


def _planned_lines(mission: Mission) -> tuple[PlannedLine, ...]:
    if mission.plan_path is None:
        return ()
    try:
        return read_plan(mission.plan_path).lines
    except (OSError, DaemonError):
        return ()
