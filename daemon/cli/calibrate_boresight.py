"""`syntopic calibrate boresight`: how the rig sits against inertial unit and antenna."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import Progress

from daemon.cli.calibration_output import publish_calibration
from daemon.cli.options import AsJson, NewFolder
from daemon.terminal.console import Console, light_table

HELP = """Estimate boresight, lever arm and time offset from a controlled block.

PROJECT is an adjustment project (docs/reference/formats.md) with control points. It is adjusted
without its antenna positions and attitudes. The result is compared with the trajectory:
`inertial.csv` in the project, or that of --mission (exposures are named as their folders). --crs is
required unless `syntopic triangulate` wrote the project. Fly two heights, opposite and crossing
lines and two speeds. Parameters the flight cannot separate are named and keep their given values.
The rig (--rig, or the mission's) holds the serial numbers of heads, lenses and probes.
Heads of the project whose delay, readout time or jitter is free are calibrated with them: fly
figures of eight.

Writes a dated folder with mount.toml, report.html and calibration.json.

Examples: `syntopic calibrate boresight project --rig midas`,
`syntopic calibrate boresight project --mission M --trajectory sbet.out --crs EPSG:25833`
"""


def boresight(
    project: Annotated[Path, typer.Argument(help="project.toml, or the folder that holds it.")],
    mission: Annotated[Path | None, typer.Option(help="Mission that holds the trajectory.")] = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Post-processed trajectory: SBET, .csv or .pos.")
    ] = None,
    crs: Annotated[str | None, typer.Option(help="Coordinate system of the project.")] = None,
    mount: Annotated[
        Path | None,
        typer.Option(help="TOML file with the current [mount] (default: the mission's)."),
    ] = None,
    rig: Annotated[
        str | None, typer.Option(help="Shipped rig or rig file (default: the mission's).")
    ] = None,
    hold: Annotated[
        list[str] | None,
        typer.Option(help="Fixed parameter: boresight, lever, time or shift; repeatable."),
    ] = None,
    lever_sigma: Annotated[
        float | None, typer.Option(help="Standard deviation of the given lever arm in m.", min=1e-6)
    ] = None,
    position_sigma: Annotated[
        tuple[float, float, float],
        typer.Option(help="Standard deviation of positions in m: east north up."),
    ] = (0.03, 0.03, 0.05),
    attitude_sigma: Annotated[
        tuple[float, float, float], typer.Option(help="Standard deviation of attitudes in mdeg.")
    ] = (3.0, 3.0, 7.0),
    position_correlation: Annotated[
        float | None,
        typer.Option(help="Correlation time of position errors in s (default: none).", min=1e-3),
    ] = None,
    attitude_correlation: Annotated[
        float | None,
        typer.Option(help="Correlation time of attitude errors in s (default: none).", min=1e-3),
    ] = None,
    previous: Annotated[
        Path | None, typer.Option(help="Folder of the calibration to compare with.")
    ] = None,
    out: NewFolder = None,
    as_json: AsJson = False,
) -> None:
    from daemon.configuration.model import MountSection
    from daemon.mission.layout import Mission
    from daemon.orientation.exterior_orientation import mount_of, read_mount
    from daemon.postflight.adjustment.project import read_project
    from daemon.postflight.calibration import boresight_calibration as flight
    from daemon.postflight.calibration.calibration_report import (
        calibration_folder,
        read_previous,
        serial_warnings,
    )
    from daemon.postflight.calibration.delay_calibration import (
        compare_with_delays,
        delay_quantities,
        delay_warnings,
        has_times,
    )
    from processing.bundle.adjust import Adjustment, adjust
    from processing.bundle.initial_values import completed
    from processing.bundle.network import Network, NetworkError
    from processing.bundle.rank_diagnosis import RankDefectError
    from processing.rig import find_rig, load_rig

    path = project / "project.toml" if project.is_dir() else project
    given = read_project(path)
    before = None if previous is None else read_previous(previous, kind="boresight")
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = calibration_folder(out, "boresight", today, next_to=path.parent)
    flown_with = None if rig is None else find_rig(rig)
    sigma_m = np.array(position_sigma)
    sigma_rad = np.radians(np.array(attitude_sigma) * 1e-3)
    stations = given.network.stations.names
    section = MountSection()
    if mission is not None:
        folder = Mission.open(mission)
        section = mount_of(folder)[0]
        flown_with = flown_with or load_rig(folder.rig_path)
        exposures, inertial = flight.inertial_of_mission(
            folder,
            stations,
            flight.system_of(path, crs),
            trajectory,
            sigma_m,
            sigma_rad,
        )
    else:
        exposures, inertial = flight.inertial_table(
            path.parent / "inertial.csv", stations, sigma_m, sigma_rad
        )
    if mount is not None:
        section = read_mount(mount)
    if (position_correlation or attitude_correlation) and inertial.time_s is None:
        raise flight.BoresightError(
            f"{path.parent / 'inertial.csv'}: a correlation time needs the column time_s"
        )
    inertial = replace(
        inertial,
        position_correlation_s=position_correlation,
        attitude_correlation_s=attitude_correlation,
    )
    held = tuple(hold or ())
    try:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("starting values", total=None)

            def adjusted(block: Network) -> Adjustment:
                return adjust(
                    block,
                    given.settings,
                    progress=lambda what, number, value: progress.update(
                        task, description=f"{what} {number}: {value:.6g}"
                    ),
                )

            network = completed(flight.control_only(given.network))
            if has_times(network):
                done = compare_with_delays(
                    network, adjusted, exposures, inertial, section, held=held,
                    lever_sigma_m=lever_sigma,
                )  # fmt: skip
            else:
                done = flight.compare_boresight(
                    adjusted(network), exposures, inertial, section, held=held,
                    lever_sigma_m=lever_sigma,
                )  # fmt: skip
    except (NetworkError, RankDefectError) as error:
        raise flight.BoresightError(
            f"the images cannot be oriented by their control: {error}"
        ) from error
    serials = {} if flown_with is None else flown_with.serials
    warnings = [] if before is None else serial_warnings(before, serials)
    if flown_with is None:
        warnings.append("the rig and the serial numbers of its parts are unknown: give --rig")
    warnings += delay_warnings(done)
    delays = delay_quantities(done)
    report = flight.report_of(
        done,
        given,
        delays=delays,
        calibration_id=place.name,
        date=today,
        serials=serials,
        previous=before,
        warnings=warnings,
    )
    if not as_json:
        console = Console()
        table = light_table("", ("", ""), ("value", "sigma", "unit"))
        for q in report.quantities:
            known = "not determined" if q.sigma is None else f"{q.sigma:.2g}"
            table.add_row(q.where, q.what, f"{q.value:.6f}", known, q.unit)
        console.print(table)
        console.print(f"sigma0 {done.found.sigma0:.3f}, redundancy {done.found.redundancy}")
    mount_file = flight.mount_toml(done, date=today, project=given.name, delays=delays)
    publish_calibration(
        report,
        place,
        files={"mount.toml": mount_file},
        as_json=as_json,
    )
