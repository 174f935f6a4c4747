"""`syntopic export rinex` and `trajectory`: observations and positions for other programs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.exit_status import exit_if_failed
from daemon.cli.options import AsJson
from daemon.terminal.console import Console

RINEX_HELP = """Export a receiver's observations as RINEX with the event marks of the exposures.

Reads the recorded RXM-RAWX of u-blox, RANGE of NovAtel and MeasEpoch of Septentrio receivers. Each
event mark is an epoch of flag 5, rounded to 100 ns (version 4.02: to the nanosecond); `marks.csv`
keeps nanoseconds and standard deviations. Ephemerides are written as `<receiver>.nav` where
RXM-SFRBX, RAWEPHEM (GPS), GPSRawCA, GALRawINAV, GLORawCA or BDSRaw was recorded. A position file of
RTKLIB comes back with `syntopic orient --trajectory`.

Examples: `syntopic export rinex MISSION`,
`syntopic export rinex MISSION --version 4.00 --antenna "NOV703GGG.R2    NONE"`
"""


def rinex(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    version: Annotated[str, typer.Option(help="RINEX version: 3.04, 4.00 or 4.02.")] = "3.04",
    receiver: Annotated[str | None, typer.Option(help="Navigator, if there are several.")] = None,
    antenna: Annotated[str, typer.Option(help="Antenna type by IGS name.")] = "",
    rtklib: Annotated[
        bool, typer.Option("--rtklib", help="Refusal of several marks between two epochs.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.export.gnss_export import export_rinex

    folder = Mission.open(mission)
    with folder.held():
        done = export_rinex(
            folder,
            version=version,
            receiver=receiver,
            antenna=antenna,
            one_mark_per_epoch=rtklib,
        )
    if as_json:
        content = {
            "folder": str(done.folder),
            "file": done.name,
            "epochs": done.written.epochs,
            "values": done.written.values,
            "values_left_out": done.written.left_out,
            "marks": done.written.marks,
            "ephemerides": len(done.ephemerides),
            "without_mark": list(done.without_mark),
            "intervals_with_several_marks": done.crowded,
            "unknown_signals": done.counts.unknown_signals,
            "unreadable_messages": done.counts.unreadable,
            "signals_of_other_antennas": done.counts.other_antennas,
            "unread_navigation_messages": list(done.unread_messages),
            "other_receivers": list(done.other_receivers),
            "failures": [failure.as_json() for failure in done.failures],
        }
        typer.echo(json.dumps(content))
        exit_if_failed(done.failures)
        return
    console = Console()
    console.print(
        f"{done.written.epochs} epochs, {done.written.values} values, {done.written.marks} event "
        f"marks in {done.folder / done.name}; {len(done.ephemerides)} ephemerides",
        soft_wrap=True,
    )
    if not done.ephemerides:
        console.print(
            f"No navigation file: the receiver recorded no complete {done.navigation_message}; use "
            "a broadcast ephemeris of the day",
            style="yellow",
            soft_wrap=True,
        )
    if done.unread_messages:
        console.print(
            f"Navigation messages that are not written: {', '.join(done.unread_messages)}",
            style="yellow",
            soft_wrap=True,
        )
    if done.other_receivers:
        console.print(
            f"Receiver {done.folder.name} of several; "
            f"{', '.join(done.other_receivers)} by --receiver",
            style="yellow",
            soft_wrap=True,
        )
    for count, what in (
        (done.written.left_out, "values do not fit RINEX's columns and are left out"),
        (done.counts.unknown_signals, "signals have no RINEX code and are left out"),
        (done.counts.unreadable, "messages could not be decoded"),
        (done.counts.other_antennas, "signals are of other antennas and are left out"),
        (len(done.without_mark), "exposures have no event mark of the receiver"),
        (done.crowded, "intervals between epochs hold several marks, of which RTKLIB reads one"),
    ):
        if count:
            console.print(f"{count} {what}", style="yellow", soft_wrap=True)
    exit_if_failed(done.failures)


TRAJECTORY_HELP = """Export a trajectory as SBET, as CSV, or as positions of RTKLIB.

The source is the navigation of the flight or a post-processed trajectory. SBET and CSV require
attitude, .pos requires standard deviations; other samples are left out and counted. SMRMSG is
written next to an SBET with --attitude-sigma. `about.json` states coordinate system, time and
point.

Examples: `syntopic export trajectory MISSION --as sbet --attitude-sigma 5 5 8`,
`syntopic export trajectory MISSION --as csv --trajectory sbet.out`
"""


def trajectory(
    mission: Annotated[Path, typer.Argument(help="Mission folder.")],
    kind: Annotated[str, typer.Option("--as", help="Format: sbet, csv or pos.")] = "sbet",
    source: Annotated[
        Path | None,
        typer.Option("--trajectory", help="Post-processed trajectory: SBET, .csv or .pos."),
    ] = None,
    receiver: Annotated[str | None, typer.Option(help="Navigator, if there are several.")] = None,
    attitude_sigma: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Standard deviation of roll, pitch, heading in mdeg."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.layout import Mission
    from daemon.postflight.export.trajectory_export import (
        FORMATS,
        TrajectoryExportError,
        export_trajectory,
    )

    if kind not in FORMATS:
        raise TrajectoryExportError(f"--as is {kind!r}; {', '.join(FORMATS)} are right")
    sigma_rad = None
    if attitude_sigma is not None:
        roll, pitch, heading = (math.radians(value * 1e-3) for value in attitude_sigma)
        sigma_rad = (roll, pitch, heading)
    folder = Mission.open(mission)
    with folder.held():
        done = export_trajectory(
            folder,
            kind,
            trajectory_file=source,
            receiver=receiver,
            attitude_sigma_rad=sigma_rad,
        )
    if as_json:
        content = {
            "folder": str(done.folder),
            "files": list(done.files),
            "samples": done.samples,
            "left_out": done.left_out,
            "trajectory": done.trajectory,
        }
        typer.echo(json.dumps(content))
        return
    console = Console()
    console.print(
        f"{done.samples} samples of {done.trajectory} in {done.folder}: {', '.join(done.files)}",
        soft_wrap=True,
    )
    if done.left_out:
        console.print(f"{done.left_out} samples do not have what {kind} requires", style="yellow")
