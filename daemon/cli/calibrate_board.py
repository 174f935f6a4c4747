"""`syntopic calibrate board`: pictures of a ChArUco board or chessboard to a dated rig file."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from daemon.cli.options import AsJson, NewFolder
from daemon.terminal.console import Console

HELP = """Calibrate lenses and relative orientation of heads from pictures of a board.

FOLDER has a folder for each head with its pictures; pictures of one instant have the same name.
With one head, the pictures may lie in FOLDER itself. The board is flat and printed with known
squares: `charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY]` counts squares,
`chessboard:COLUMNSxROWS:SQUARE` counts inner corners; lengths have a unit.

Focus the lenses as in flight and fix the focus ring. Take ten pictures or more with each head:
corners in all parts of the image, the board tilted by 20 to 40 degrees in all four directions, and
rotated by 90 and 180 degrees. `--watch` follows a folder into which pictures arrive, and prints
what is still missing. For the relative orientation, heads see the board at the same instant.

The new folder holds a dated rig file, the covariance, a report with plots, and the comparison with
a previous calibration. The rig becomes calibrated when every head has a lens and an orientation.

Examples: `syntopic calibrate board pictures --rig rig.toml --board charuco:11x8:30mm:22mm`,
`syntopic calibrate board pictures --rig rig.toml --board chessboard:9x6:25mm --watch`

Pictures to try: `python -m sim_hw.laboratory.calibration_board --out board`
"""


def board(
    folder: Annotated[Path, typer.Argument(help="Folder of the pictures.")],
    rig: Annotated[str, typer.Option(help="Rig file, or name of a shipped rig.")],
    board: Annotated[str, typer.Option(help="Board, such as charuco:11x8:30mm:22mm.")],
    watch: Annotated[
        bool, typer.Option("--watch", help="Print coverage while pictures arrive.")
    ] = False,
    watch_timeout: Annotated[
        float, typer.Option(help="Time without a new picture that ends --watch, in s.", min=1.0)
    ] = 600.0,
    board_tolerance: Annotated[
        str,
        typer.Option(help="Standard deviation of the board's corners against the drawing."),
    ] = "0.1mm",
    k3: Annotated[bool, typer.Option("--k3", help="Estimation of K3.")] = False,
    affinity: Annotated[bool, typer.Option("--affinity", help="Estimation of B1 and B2.")] = False,
    focused_at: Annotated[
        str | None,
        typer.Option(help="Distance at which the lenses are focused (default: infinity)."),
    ] = None,
    temperature: Annotated[
        float | None, typer.Option(help="Temperature of the heads in degC.")
    ] = None,
    previous: Annotated[
        Path | None, typer.Option(help="Calibration from a board to compare with.")
    ] = None,
    out: NewFolder = None,
    as_json: AsJson = False,
) -> None:
    from daemon.cli.board_watch import watch_pictures
    from daemon.cli.calibration_output import publish_calibration
    from daemon.initialization.answers import lengths
    from daemon.postflight.calibration.board.findings import findings_of
    from daemon.postflight.calibration.board.pictures import (
        board_refusals,
        picture_files,
        read_views,
    )
    from daemon.postflight.calibration.board.report import (
        KIND,
        board_report,
        calibrated_rig,
        rig_file,
    )
    from daemon.postflight.calibration.calibration_report import calibration_folder, read_previous
    from daemon.postflight.calibration.head_parameters import covariance_bytes
    from processing.calibration.board.adjustment import BoardSettings, calibrate_board
    from processing.calibration.board.network import FREE
    from processing.matching.calibration_board import parse_board
    from processing.rig import find_rig

    with board_refusals():
        old, drawn = find_rig(rig), parse_board(board)
    (tolerance_mm,) = lengths(board_tolerance, "mm", 1)
    focused_m = None if focused_at is None else lengths(focused_at, "m", 1)[0]
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    place = calibration_folder(out, f"{old.name}-board", today, next_to=folder)
    before = None if previous is None else read_previous(previous, kind=KIND)
    console = Console(stderr=True)
    if watch:
        with board_refusals():
            watch_pictures(folder, old, drawn, console=console, timeout_s=watch_timeout)
    with board_refusals(), Progress(console=console, transient=True) as progress:
        task = progress.add_task("reading", total=None)

        def show_progress(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total or None)

        pictures = read_views(picture_files(folder, old), old, drawn, progress=show_progress)
        free = (*FREE, *(("k3",) if k3 else ()), *(("b1", "b2") if affinity else ()))
        found = calibrate_board(
            old,
            drawn,
            pictures.views,
            BoardSettings(free, tolerance_mm),
            progress=show_progress,
        )
    found = replace(found, left_out=(*pictures.left_out, *found.left_out))
    findings = findings_of(found, focused_m=focused_m)
    made, stays_uncalibrated = calibrated_rig(
        found, findings, date=today, temperature_c=temperature, focused_m=focused_m
    )
    report = board_report(
        found,
        findings,
        calibration_id=place.name,
        date=today,
        source=str(folder),
        stays_uncalibrated=stays_uncalibrated,
        previous=before,
    )
    publish_calibration(
        report,
        place,
        files={"covariance.npz": covariance_bytes(found)},
        rig_file=lambda name: rig_file(
            replace(made, calibration_id=name), found, date=today, blocking=findings.blocking
        ),
        as_json=as_json,
    )
