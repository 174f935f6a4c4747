"""`syntopic pansharpen`: Level-3 after landing, pansharpened and in one tone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress

from daemon.cli.batch_options import ExecutorOptions, takes_executor
from daemon.cli.exit_status import exit_if_failed
from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError
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

Exposures are computed by as many processes as cores and memory allow, or by a cluster.

Examples: `syntopic pansharpen MISSION`, `syntopic pansharpen MISSION --only 3 --image cir --bits 8`
"""


@takes_executor
def pansharpen(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    only: Annotated[
        list[int] | None, typer.Option(help="Number of an exposure; repeatable.")
    ] = None,
    image: Annotated[list[str] | None, typer.Option(help="Image: rgb or cir; repeatable.")] = None,
    bits: Annotated[
        list[int] | None, typer.Option(help="Bits per sample: 16 or 8; repeatable.")
    ] = None,
    *,
    where: ExecutorOptions,
    as_json: AsJson = False,
) -> None:
    from daemon.postflight.batch.executor import BatchTask
    from daemon.postflight.batch.pansharpen_work import PansharpenWork
    from daemon.products import level3
    from processing.rig import load_rig

    images, depths = image or list(level3.IMAGES), bits or list(level3.DEPTHS)
    if set(images) - set(level3.IMAGES) or set(depths) - set(level3.DEPTHS):
        raise ConfigurationError(["--image is rgb or cir, --bits is 16 or 8"])
    where.check()
    folder = Mission.open(mission)
    rig = load_rig(folder.rig_path)
    with folder.held():
        sweep(level3.level3_root(folder))
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("histograms", total=None)
            tones, unreadable = level3.mission_tones(
                folder,
                rig,
                lambda _, done, total: progress.update(task, completed=done, total=total),
            )
        unreadable_numbers = {failure.exposure for failure in unreadable}
        requested = dict.fromkeys(only or sorted(tones.scales))
        numbers = [number for number in requested if number not in unreadable_numbers]
        work = PansharpenWork(folder.path.absolute(), tones, tuple(images), tuple(depths))
        outcome = where.run(work, [BatchTask(number) for number in numbers], "pansharpening")
    walked = outcome.results
    rows = [walked[number] for number in sorted(walked)]
    failures = (*unreadable, *outcome.failures)
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
    if outcome.is_interrupted:
        raise KeyboardInterrupt
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
