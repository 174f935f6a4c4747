"""`syntopic pansharpen`: Level-3 after landing, pansharpened and in one tone."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress

from daemon.cli.exit_status import exit_if_failed
from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError
from daemon.mission.exposure_batch import for_each_exposure
from daemon.mission.layout import Mission
from daemon.mission.store.publication import sweep
from daemon.terminal.console import Console, light_table

if TYPE_CHECKING:
    from daemon.products.level3 import PansharpenedExposure

HELP = """Compute Level-3 of a mission: pansharpened RGB and CIR in 16 and 8 bits.

One tone curve serves all exposures that have Level-2, so that neighbouring images match; it is
computed again from all of them in each run. Earlier images of an exposure are replaced.

An exposure that cannot be pansharpened is listed at the end with its cause and excluded from the
tone curve. The others are processed.

Examples: `syntopic pansharpen MISSION`, `syntopic pansharpen MISSION --only 3 --image cir --bits 8`
"""


def pansharpen(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    only: Annotated[
        list[int] | None, typer.Option(help="Number of an exposure; repeatable.")
    ] = None,
    image: Annotated[list[str] | None, typer.Option(help="Image: rgb or cir; repeatable.")] = None,
    bits: Annotated[
        list[int] | None, typer.Option(help="Bits per sample: 16 or 8; repeatable.")
    ] = None,
    threads: Annotated[int, typer.Option(help="Number of threads.", min=1)] = 2,
    as_json: AsJson = False,
) -> None:
    import cv2

    from daemon.products import level3
    from processing.rig import load_rig

    images, depths = image or list(level3.IMAGES), bits or list(level3.DEPTHS)
    if set(images) - set(level3.IMAGES) or set(depths) - set(level3.DEPTHS):
        raise ConfigurationError(["--image is rgb or cir, --bits is 16 or 8"])
    cv2.setNumThreads(threads)
    folder = Mission.open(mission)
    rig = load_rig(folder.rig_path)
    with folder.held(), Progress(console=Console(stderr=True), transient=True) as progress:
        sweep(level3.level3_root(folder))
        task = progress.add_task("histograms", total=None)
        tones, unreadable = level3.mission_tones(
            folder, rig, lambda _, done, total: progress.update(task, completed=done, total=total)
        )

        def develop_one(number: int) -> tuple[level3.PansharpenedExposure, float]:
            started = time.monotonic()
            done = level3.pansharpen(
                folder, rig, number, tones, images=images, depths=depths, threads=threads
            )
            return done, time.monotonic() - started

        unreadable_numbers = {failure.exposure for failure in unreadable}
        numbers = [
            number for number in only or sorted(tones.scales) if number not in unreadable_numbers
        ]
        progress.update(task, description="developing", total=len(numbers), completed=0)
        walked = for_each_exposure(
            numbers, develop_one, lambda count: progress.update(task, completed=count)
        )
    rows = list(walked.results.values())
    failures = (*unreadable, *walked.failures)
    if as_json:
        content = {
            "mission": str(folder.path),
            "tone_curve_sha256": tones.sha256,
            "exponent": tones.curve.exponent,
            "exposures": [
                {
                    "exposure": done.number,
                    "files": dict(done.files),
                    "left_out": list(done.left_out),
                    "duration_s": round(seconds, 3),
                }
                for done, seconds in rows
            ],
            "failures": [failure.as_json() for failure in failures],
        }
        typer.echo(json.dumps(content))
    else:
        _print_table(rows, level3.level3_root(folder))
    exit_if_failed(failures)


def _print_table(rows: Sequence[tuple[PansharpenedExposure, float]], root: Path) -> None:
    table = light_table("Level-3", (), ("exposure", "files", "MB", "s"))
    for done, seconds in rows:
        nbytes = sum(done.files.values())
        table.add_row(
            str(done.number), str(len(done.files)), f"{nbytes / 1e6:.1f}", f"{seconds:.1f}"
        )
    console = Console()
    console.print(table)
    for done, _ in rows:
        for sentence in done.left_out:
            console.print(f"Exposure {done.number}: {sentence}", style="yellow", markup=False)
    console.print(f"Images are in {root}")
