"""`syntopic triangulate`: aerial triangulation of a mission."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.progress import Progress

from daemon.cli.batch_options import ExecutorOptions, takes_executor
from daemon.cli.exit_status import ExitStatus, exit_if_failed
from daemon.cli.options import (
    AsJson,
    Crs,
    MountFile,
    Trajectory,
    lock_for,
)
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.mission.layout import Mission
    from daemon.orientation.navigation_sigmas import NavigationSigmas
    from processing.bundle.flown_network import GnssDrift
    from processing.bundle.self_calibration import SetName

HELP = """Triangulate the stitched PAN images of a mission, or the images of its heads.

Direct georeferencing gives the initial orientation. Tie points are matched between all overlapping
exposures, also of opposite and crossing lines. Control and check points come from two tables: where
they are on the ground (--points) and where in the images (--measured). Writes an adjustment project
with its report (image residuals in um, control and checks in m and px, systematic image residuals
on a grid), `exterior.csv` with the adjusted orientations, and all the tables
docs/reference/formats.md names.

If the heads of a rig have diverging axes, heads with equal pixels and principal distance form a
block (--head). Views of similar direction are matched, oblique ones by the plane of the ground.

With --live, the mission is triangulated as in flight: exposure by exposure, by the navigation of
each record. Results are in export/triangulation/live: live.json, orientations.csv and report.html.
Points then take no part in the adjustment, and the report has their residuals; without --measured
only those of heights.

A mission of photographs (`syntopic import photographs`) is oriented from features of its images
without attitudes, and the interior orientation is estimated; control from an ODM `gcp_list.txt`
(--points alone) or the two tables, with images named by file.

Examples: `syntopic triangulate MISSION --trajectory sbet.out`,
`syntopic triangulate MISSION --live`,
`syntopic triangulate MISSION --head 5 --head 8`,
`syntopic triangulate MISSION --set sensors-full --points points.csv --measured measured.csv`
"""

IMAGES_PER_PROCESS = 12
"""So many images take longer to match than the start of a process."""
SETS = ("none", "radial", "sensors", "sensors-full")


@takes_executor
def triangulate(
    mission: Annotated[Path, typer.Argument(help="Mission folder with Level-2.")],
    set_name: Annotated[
        str,
        typer.Option(
            "--set",
            help="Parameters: none, radial, sensors or sensors-full "
            "(docs/reference/results/bundle.md).",
        ),
    ] = "none",
    interior: Annotated[
        bool,
        typer.Option(
            "--interior", help="Estimation of dx0, dy0 and df; requires GNSS and two heights."
        ),
    ] = False,
    points: Annotated[Path | None, typer.Option(help="Table of control and check points.")] = None,
    measured: Annotated[
        Path | None, typer.Option(help="Table of their image measurements.")
    ] = None,
    transfer: Annotated[
        bool,
        typer.Option(
            "--transfer",
            help="Points also in other images that show them, matched to where they were first "
            "measured.",
        ),
    ] = False,
    head: Annotated[
        list[str] | None,
        typer.Option(help="Cone whose images form the block instead of stitched ones; repeatable."),
    ] = None,
    trajectory: Trajectory = None,
    mount: MountFile = None,
    crs: Crs = None,
    gnss: Annotated[
        str, typer.Option(help="Model of GNSS errors per line: none, shift or linear.")
    ] = "none",
    patterns: Annotated[
        bool,
        typer.Option(
            "--patterns/--no-patterns",
            help="Unknowns for what stitching may have left in each image, at most eight, as "
            "recorded by `syntopic process`.",
        ),
    ] = True,
    position_sigma: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Standard deviation of positions in m: east north up (default: as the receiver "
            "states, else as configured, 0.05 0.05 0.08; of photographs 3 3 5)."
        ),
    ] = None,
    attitude_sigma: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Standard deviation of roll, pitch, heading in mdeg (default: as configured, 5 5 "
            "8)."
        ),
    ] = None,
    boresight_sigma: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of the calibrated boresight's angles in mdeg (default: as "
            "configured, 6).",
            min=1e-3,
        ),
    ] = None,
    lever_sigma: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of the calibrated lever arm in m (default: as configured, "
            "0.02).",
            min=1e-6,
        ),
    ] = None,
    search: Annotated[
        int, typer.Option(help="Search radius around the prediction in pixels.", min=4, max=200)
    ] = 24,
    reject: Annotated[
        float, typer.Option(help="Rejection limit of image points in sigmas.", min=2.0)
    ] = 4.0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for results (default: in the mission's export).")
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Triangulation exposure by exposure, as in flight.")
    ] = False,
    *,
    where: ExecutorOptions,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission

    folder = Mission.open(mission)
    where.check()
    if transfer and (points is None or measured is None or live):
        raise ConfigurationError(
            ["--transfer needs --points and --measured, the points to find, and is not of --live"]
        )
    if live:
        from daemon.cli.triangulate_live import triangulate_live

        sigmas = _sigmas(folder, position_sigma, attitude_sigma, boresight_sigma, lever_sigma)
        triangulate_live(
            folder, sigmas, trajectory, points=points, measured=measured, as_json=as_json
        )
        return
    from daemon.cli.adjust import _peak_mib
    from daemon.cli.triangulate_photographs import POSITION_SIGMA_M, triangulate_photographs
    from daemon.mission.store.output_places import refuse_mission_folder
    from daemon.postflight.adjustment.project_writer import refuse_existing_project
    from daemon.postflight.adjustment.summary import print_report, report_of
    from daemon.postflight.importers.photographs import is_photographs
    from daemon.postflight.triangulation.block_findings import findings_json
    from daemon.postflight.triangulation.matching_work import match_mission_block
    from daemon.postflight.triangulation.measured_points import read_measured_points
    from daemon.postflight.triangulation.point_transfer import transferred
    from daemon.postflight.triangulation.report import (
        print_triangulation,
        triangulation_of,
        write_triangulation,
    )
    from daemon.postflight.triangulation.triangulation import (
        TriangulationError,
        TriangulationSettings,
        block_of,
        project_of,
        weight_by_residuals,
    )
    from processing.bundle.adjust import adjust
    from processing.bundle.initial_values import completed
    from processing.bundle.network import NetworkError
    from processing.bundle.rank_diagnosis import RankDefectError
    from processing.matching.block_matching import BlockMatching

    if set_name not in SETS or gnss not in ("none", "shift", "linear"):
        raise ConfigurationError(
            [f"--set is one of {', '.join(SETS)}; --gnss is none, shift or linear"]
        )
    begun = time.perf_counter()
    of_photographs = is_photographs(folder)
    name = "photographs" if of_photographs else set_name
    results = out or folder.export_dir / "triangulation" / name
    refuse_mission_folder(results, folder, cure="give another folder with --out")
    refuse_existing_project(results)
    if of_photographs:
        triangulate_photographs(
            folder,
            results,
            points=points,
            measured=measured,
            crs=crs,
            position_sigma_m=position_sigma or POSITION_SIGMA_M,
            reject_beyond=reject,
            compute=lambda step: where.compute(step, IMAGES_PER_PROCESS),
            as_json=as_json,
        )
        return
    requirements = TriangulationSettings(
        parameters=cast("SetName", set_name),
        interior=interior,
        sigmas=_sigmas(folder, position_sigma, attitude_sigma, boresight_sigma, lever_sigma),
        drift=cast("GnssDrift", gnss),
        patterns=patterns,
        reject_beyond=reject,
        matching=BlockMatching(first_search_px=search),
    )
    block = block_of(
        folder, crs=crs, trajectory_file=trajectory, mount_file=mount, heads=head or ()
    )
    surveyed = read_measured_points(block.names, block.frame, points, measured)
    with lock_for(folder, results), ExitStack() as shown:
        try:
            tied = match_mission_block(
                block, requirements.matching, where.compute("matching", IMAGES_PER_PROCESS)
            )
        except NetworkError as error:
            raise TriangulationError(f"{folder.path}: {error}") from error
        progress = shown.enter_context(Progress(console=Console(stderr=True), transient=True))
        task = progress.add_task("starting values", total=None)
        if transfer:
            progress.update(task, description="transferring points")
            surveyed = transferred(block, surveyed, requirements.matching)
        project = project_of(block, tied, requirements, surveyed=surveyed)
        try:

            def show(what: str, number: int, squares: float) -> None:
                progress.update(task, description=f"{what} {number}: {squares:.6g}")

            project = weight_by_residuals(project, tied.points, show)
            result = adjust(completed(project.network), project.settings, progress=show)
        except (NetworkError, RankDefectError) as error:
            raise TriangulationError(f"{folder.path}: {error}") from error
        report = report_of(
            result,
            project.checks,
            name=project.name,
            seconds=time.perf_counter() - begun,
            peak_mib=_peak_mib(),
        )
        report["triangulation"] = triangulation_of(block, tied, project, result) | findings_json(
            block, tied, result, requirements
        )
        report["failures"] = [failure.as_json() for failure in block.failures]
        write_triangulation(results, block, project, result, report)
    if as_json:
        typer.echo(json.dumps(report | {"folder": str(results)}))
        exit_if_failed(block.failures)
        _exit_if_not_final(result.problems)
        return
    console = Console()
    short = report | {"rejected": [], "left_out": [], "control": {"count": 0}}
    print_report(console, short | {"checks": {"count": 0}})
    console.print(
        f"{len(report['rejected'])} image points and {len(report['left_out'])} object points left "
        "out",
        highlight=False,
    )
    print_triangulation(console, report["triangulation"])
    console.print(f"Results: {results}, report {results / 'report.html'}", soft_wrap=True)
    exit_if_failed(block.failures)
    _exit_if_not_final(result.problems)


def _sigmas(
    mission: Mission,
    position_m: tuple[float, float, float] | None,
    attitude_mdeg: tuple[float, float, float] | None,
    boresight_mdeg: float | None,
    lever_arm_m: float | None,
) -> NavigationSigmas:
    """Standard deviations as configured for the flight, or as given."""
    from daemon.orientation.navigation_sigmas import flown_sigmas

    flown = flown_sigmas(mission)
    return replace(
        flown,
        position_m=position_m or flown.position_m,
        attitude_mdeg=attitude_mdeg or flown.attitude_mdeg,
        boresight_mdeg=boresight_mdeg or flown.boresight_mdeg,
        lever_arm_m=lever_arm_m or flown.lever_arm_m,
        uses_stated=position_m is None,
    )


def _exit_if_not_final(problems: Sequence[str]) -> None:
    """End with a status when the adjustment reports that its result is not final."""
    if problems:
        raise typer.Exit(ExitStatus.PROBLEM)
