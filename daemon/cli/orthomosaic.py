"""`syntopic orthomosaic`: the orthomosaic of a mission after landing."""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.batch_options import ExecutorOptions, takes_executor
from daemon.cli.exit_status import ExitStatus, exit_if_failed
from daemon.cli.options import AsJson, Crs, MountFile, Trajectory, lock_for
from daemon.configuration.model import ConfigurationError
from daemon.mission.layout import Mission
from daemon.terminal.console import Console

HELP = """Compute the orthomosaic of the stitched images or photographs of a mission.

Images are resampled to a map grid over a height model or a plane, each ground pixel from the image
whose nadir is nearest, and levelled over the block. Orientations are those of `syntopic
triangulate`, else those delivered with the mission. Imported photographs need a triangulation and
are undistorted by its interior orientation. Writes Cloud Optimized GeoTIFFs (PAN, RGB and
CIR, 16 and 8 bits), seams as GeoPackage and orthomosaic.json.

An interrupted run continues when it is repeated. The same inputs give the same bytes.

Examples: `syntopic orthomosaic MISSION --elevation dtm.tif`,
`syntopic orthomosaic MISSION --ground-height 412.5 --image rgb --bits 8`,
`syntopic orthomosaic MISSION --triangulation MISSION/export/triangulation/none --gsd 0.1`
"""

STEPS_PER_PROCESS = 8
"""So many images or tiles take longer than the start of a process."""


@takes_executor
def orthomosaic(
    mission: Annotated[
        Path, typer.Argument(help="Mission folder with Level-2, or of photographs.")
    ],
    triangulation: Annotated[
        Path | None,
        typer.Option(help="Folder of a triangulation (default: the only one in the export)."),
    ] = None,
    elevation: Annotated[
        Path | None, typer.Option(help="Height model (default: that of the flight, else a plane).")
    ] = None,
    ground_height: Annotated[
        float | None,
        typer.Option(help="Height of a plane in m, in the height system of the CRS."),
    ] = None,
    gsd: Annotated[
        float | None, typer.Option(help="Ground sampling distance in m (default: of the images).")
    ] = None,
    image: Annotated[
        list[str] | None, typer.Option(help="Image: pan, rgb or cir; repeatable (default: all).")
    ] = None,
    bits: Annotated[
        list[int] | None, typer.Option(help="Bits per sample: 16 or 8; repeatable (default: both).")
    ] = None,
    level: Annotated[
        bool, typer.Option("--level/--no-level", help="Radiometric levelling of the block.")
    ] = True,
    trajectory: Trajectory = None,
    mount: MountFile = None,
    crs: Crs = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for results (default: in the mission's export).")
    ] = None,
    *,
    where: ExecutorOptions,
    as_json: AsJson = False,
) -> None:
    os.environ.setdefault("NUMBA_NUM_THREADS", str(where.threads or 2))
    from daemon.postflight.orthomosaic.orthomosaic import (
        DEPTHS,
        OrthomosaicSettings,
        make_orthomosaic,
        relief_sentence,
    )
    from daemon.postflight.orthomosaic.orthomosaic_work import OrthomosaicRequest
    from daemon.postflight.orthomosaic.rasters import IMAGES
    from daemon.postflight.orthomosaic.work_folder import refuse_foreign_places
    from drivers.base.extras import require

    require("geotiff")
    images, depths = tuple(image or IMAGES), tuple(bits or DEPTHS)
    if set(images) - set(IMAGES) or set(depths) - set(DEPTHS):
        raise ConfigurationError(["--image is pan, rgb or cir, --bits is 16 or 8"])
    if gsd is not None and not 0.0 < gsd < math.inf:
        raise ConfigurationError([f"--gsd is {gsd:g}; it is positive, in metres"])
    where.check()
    begun = time.monotonic()
    folder = Mission.open(mission)
    final = out or folder.export_dir / "orthomosaic"
    refuse_foreign_places(final.resolve(), folder)
    request = OrthomosaicRequest(
        folder.path.absolute(), triangulation and triangulation.absolute(),
        elevation and elevation.absolute(), ground_height, gsd, crs,
        trajectory and trajectory.absolute(), mount and mount.absolute(),
    )  # fmt: skip
    block = request.block()
    bar = Progress(console=Console(stderr=True), transient=True)
    task = bar.add_task("files", total=None)

    def show(done: int, total: int) -> None:
        bar.start()
        bar.update(task, completed=done, total=total)

    with lock_for(folder, final):
        try:
            report = make_orthomosaic(
                request,
                block,
                final,
                OrthomosaicSettings(images, depths, level),
                compute=lambda step: where.compute(step, STEPS_PER_PROCESS),
                progress=show,
            )
        finally:
            bar.stop()
    report |= {"folder": str(final), "seconds": round(time.monotonic() - begun, 2)}
    if as_json:
        typer.echo(json.dumps(report))
    else:
        console = Console()
        console.print(
            f"{report['width_px']} x {report['height_px']} pixels of {report['gsd_m']:g} m from "
            f"{report['images_used']} of {report['images']} images, {report['orientation']}",
            highlight=False,
        )
        steps = report["seams"]
        if steps["step_rms_before"]["pan"] is not None:
            console.print(
                f"Signal steps at seams, PAN: {steps['step_rms_before']['pan']:.2%} RMS before, "
                f"{steps['step_rms_after']['pan']:.2%} after levelling",
                highlight=False,
            )
        found = [f"{one['name']}: {one['sentence']}" for one in report["findings"]]
        for sentence in (*report["left_out"], *found, relief_sentence(report)):
            if sentence:
                console.print(sentence, style="yellow", markup=False, highlight=False)
        console.print(f"Results: {final}", soft_wrap=True)
    exit_if_failed(block.failures)
    if block.ground_check.is_wrong:
        raise typer.Exit(ExitStatus.PROBLEM)
