"""`syntopic demo`: the main job, end to end, with everything emulated.

Emulator, service and judge are separate processes, as they are in life; this file starts them and
shows what they say.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.live import Live
from rich.table import Table
from rich.text import Text

from daemon import DaemonError
from daemon.cli.exit_status import ExitStatus, status_of
from daemon.cli.options import AsJson
from daemon.cli.sim import (
    Emulator,
    free_first_address,
    service_toml,
    simulator_arguments,
    write_service_file,
)
from daemon.terminal.console import Console, light_table
from drivers.base.extras import require
from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import DcFigures
from processing.quality.figures.stitching import (
    AdjustmentFigures,
    DisplacedSensorFigures,
    TiePointFigures,
)
from processing.rig import Rig, RigError, find_rig

HELP = """Fly a first flight with an emulated rig: capture, stitching and verdict.

A line of exposures is flown 12 K above the calibration temperature, with one sensor of the master
cone displaced where it has several. The stitched images are then compared with the emulator's
truth, and with what the older, fixed method would have given.

Examples: `syntopic demo`, `syntopic demo --rig ultracam-l-mini`, `syntopic demo --json`
"""
EVENT_TIMEOUT_S = 180.0


class DemoError(DaemonError):
    """The demonstration cannot continue; the message states where to look."""


def demo(
    rig: Annotated[str, typer.Option(help="Rig.")] = "ultracam-x-mini",
    exposures: Annotated[int, typer.Option(help="Number of exposures.", min=1)] = 12,
    dc: Annotated[float, typer.Option(help="Temperature above calibration in K.")] = 12.0,
    displace: Annotated[
        str | None,
        typer.Option(
            help="The displaced sensor and its displacement in px; '' for none. By default "
            "SU02=1.0,-0.6, or none where a rig's master cone has too few sensors to name one."
        ),
    ] = None,
    receiver: Annotated[
        str,
        typer.Option(
            help="Receiver: ublox, novatel, septentrio, nmea, sbg, vectornav, xsens, applanix, "
            "gsof or mavlink."
        ),
    ] = "ublox",
    seed: Annotated[int, typer.Option(help="Seed for all random generators.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder of the flights.")] = Path("flights"),
    as_json: AsJson = False,
) -> None:
    require("aravis", "watch", *(["mavlink"] if receiver == "mavlink" else []))
    console = Console(stderr=as_json)
    folder = out / f"demo-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    try:
        displace = _displacement(find_rig(rig)) if displace is None else displace
    except RigError as error:
        console.print(str(error), style="bold red")
        raise typer.Exit(ExitStatus.REFUSED) from error
    arguments = simulator_arguments(
        rig, folder / "sim", seed=seed, dc=dc, displace=[displace] if displace else []
    )
    arguments += ["--scene-cache", str(out / "scenes"), "--exposures", str(exposures + 1)]
    arguments += ["--first-address", free_first_address(), "--receiver", receiver]
    console.print(f"Emulating {rig} at dC = {dc:+g} K, displaced: {displace or 'none'}")
    emulator = Emulator(arguments)
    try:
        mission, ledger = _fly(console, emulator, folder, exposures)
    finally:
        emulator.end()
    result = _compare_with_truth(console, mission, Path(emulator.ready["truth"]), ledger)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print_result(console, result, ledger)
    raise typer.Exit(status_of(is_good=result["lost"] == 0 and result["ledger_balanced"]))


def _displacement(rig: Rig) -> str:
    """The third sensor of the master cone, by a pixel; nothing where no sensor could be named."""
    master = rig.master_sensors
    return f"{master[2].name}=1.0,-0.6" if len(master) >= 3 else ""


def _fly(
    console: Console, emulator: Emulator, folder: Path, exposures: int
) -> tuple[Path, Mapping[str, Any]]:
    """Run the service until the line is flown.

    Returns:
        The mission folder, and the ledger's sheet.
    """
    config = folder / "service.toml"
    text = service_toml(
        emulator.ready,
        root="missions",
        count=exposures,
        baselines=True,
        end_when_done=True,
        watch_port=0,
    )
    write_service_file(config, text)
    log = (folder / "service.log").open("w")
    service = subprocess.Popen(
        [
            *(sys.executable, "-m", "daemon", "run", str(config), "--json-lines"),
            *("--parent", str(os.getpid())),
        ],
        stdout=subprocess.PIPE,
        stderr=log,
        text=True,
    )
    console.print("Service: loading kernels, opening devices")
    rows: dict[int, dict[str, Any]] = {}
    mission: Path | None = None
    ledger: Mapping[str, Any] | None = None
    try:
        with Live(_table(rows, exposures), console=console, refresh_per_second=4) as live:
            for event in _events(service):
                name = event["event"]
                if name == "mission":
                    mission = Path(event["path"])
                elif name == "watching":
                    address = f"http://{event['host']}:{event['port']}/"
                    live.console.print(f"Watch it at {address}")
                elif name == "ended":
                    ledger = event["ledger"]
                elif name == "fault" or event.get("fault"):
                    live.console.print(str(event["sentence"]), style="yellow")
                elif "number" in event:
                    rows.setdefault(event["number"], {})[name] = event
                live.update(_table(rows, exposures))
        if not console.is_terminal:  # a live table ends without an end of line there
            console.print()
        status = service.wait(30)
    finally:
        if service.poll() is None:
            service.kill()
        log.close()
    if mission is None or ledger is None or status != 0:
        raise DemoError(f"the service ended with status {status}; see {folder / 'service.log'}")
    return mission, ledger


def _events(service: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    """Events of the service, one per line, until it ends."""
    assert service.stdout is not None
    for line in service.stdout:
        yield json.loads(line)


def _table(rows: Mapping[int, Mapping[str, Any]], exposures: int) -> Table:
    """The live table; it fits a terminal of 80 columns."""
    table = light_table(f"Line 1, {exposures} exposures", (), _HEADINGS)
    for number, events in sorted(rows.items()):
        table.add_row(str(number), *_cells(events))
    return table


_HEADINGS = (
    "no",
    "GPS time",
    "±ns",
    "frames",
    "dC",
    "tie points",
    "s0 px",
    "um",
    "moved",
    "verdict",
)


def _cells(events: Mapping[str, Any]) -> list[str | Text]:
    if "lost" in events:
        return ["", "", "0", "", "", "", "", "", Text("lost", "red")]
    sealed = events.get("sealed")
    if sealed is None:
        return ["", "", "", "", "", "", "", "", "stored" if "stored" in events else "triggered"]
    cells = [_gps_text(sealed["mark_gps_ns"]), str(sealed["mark_sigma_ns"]), str(sealed["frames"])]
    if "processed" not in events:
        return [*cells, "", "", "", "", "", "sealed"]
    report = events["processed"]["report"]
    figures = QualityFigures.from_json(report["figures"])
    adjustment, points = figures.of(AdjustmentFigures), figures.of(TiePointFigures)
    colour = {"good": "green", "usable": "yellow", "refly": "red"}[report["verdict"]]
    return [
        *cells,
        _number(figures.of(DcFigures).dc_k, "+.1f"),
        f"{points.tie_points_pp or 0}+{points.tie_points_pc or 0}",
        _number(adjustment.sigma0_px, ".3f"),
        _number(adjustment.sigma0_um, ".2f"),
        figures.of(DisplacedSensorFigures).displaced_sensor or "-",
        Text(str(report["verdict"]), colour),
    ]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _gps_text(gps_ns: str | None) -> str:
    """Second of the GPS week; the week is in the record."""
    if gps_ns is None:
        return "-"
    seconds, nanoseconds = divmod(int(gps_ns), 1_000_000_000)
    return f"{seconds % 604_800}.{nanoseconds // 100_000:04d}"


def _compare_with_truth(
    console: Console, mission: Path, truth: Path, ledger: Mapping[str, Any]
) -> dict[str, Any]:
    """Hold the products against the emulator's truth, and write the report."""
    from daemon.postflight.mission_report import write_report

    started = time.monotonic()
    with console.status("comparing the stitched images with the truth"):
        comparison = subprocess.run(
            [
                *(sys.executable, "-m", "sim_hw.truth_comparison"),
                *("--mission", str(mission), "--truth", str(truth)),
            ],
            capture_output=True,
            text=True,
            timeout=EVENT_TIMEOUT_S,
            check=False,
        )
    if comparison.returncode != 0:
        raise DemoError(f"the judge failed: {comparison.stderr.strip()[-500:]}")
    geometry = json.loads(comparison.stdout)
    reports = [
        json.loads(path.read_text()) for path in sorted((mission / "L2").glob("*/quality.json"))
    ]
    named = [
        QualityFigures.from_json(report["figures"]).of(DisplacedSensorFigures).displaced_sensor
        for report in reports
    ]
    counts = ledger["triggers"]
    free = geometry["methods"].get("free", {})
    return {
        "exposures": counts["triggers"],
        "complete": counts["complete"],
        "degraded": counts["degraded"],
        "lost": counts["lost"],
        "ledger_balanced": ledger["balanced"],
        "rms_px": free.get("inner_rms_px"),
        "max_px": free.get("inner_max_px"),
        "rms_px_absolute": free.get("absolute_rms_px"),
        "max_px_absolute": free.get("absolute_max_px"),
        "rms_px_fixed": geometry["methods"].get("fixed", {}).get("inner_rms_px"),
        "rms_px_no_tdm": geometry["methods"].get("fixed-no-tdm", {}).get("inner_rms_px"),
        "displaced_sensor": named[0] if named and len(set(named)) == 1 else None,
        "displaced_sensors": named,
        "time_sigma_ns": max((_time_sigma(mission)), default=None),
        "time_error_ns": geometry.get("time_error_ns"),
        "verdicts": [report["verdict"] for report in reports],
        "mission": str(mission),
        "report": str(write_report(mission, ledger=ledger, geometry=geometry).path),
        "judged_s": round(time.monotonic() - started, 2),
    }


def _time_sigma(mission: Path) -> Iterator[int]:
    for path in (mission / "L0").glob("*/exposure.json"):
        sigma_ns = json.loads(path.read_text()).get("mark_sigma_ns")
        if sigma_ns is not None:
            yield sigma_ns


def _print_result(console: Console, result: Mapping[str, Any], ledger: Mapping[str, Any]) -> None:
    counts = ledger["triggers"]
    sheet = light_table("Ledger", ("",), ("triggers", "complete", "degraded", "lost", "open"))
    sheet.add_row(
        "exposures",
        *(str(counts[key]) for key in ("triggers", "complete", "degraded", "lost", "open")),
    )
    console.print(sheet)
    causes = ("received", "used", "late", "duplicate", "corrupt", "spurious")
    received = light_table("", ("",), causes)
    for name in ("frames", "marks"):
        received.add_row(name, *(str(ledger[name][cause]) for cause in causes))
    console.print(received)
    console.print("balanced" if result["ledger_balanced"] else "does not balance")
    if result["rms_px"] is None:
        console.print("Nothing is stitched: every head has an image and an orientation of its own")
    else:
        _print_geometry(console, result)
    console.print(f"Event marks: sigma {result['time_sigma_ns']} ns")
    console.print(f"Mission  {result['mission']}", soft_wrap=True)
    console.print(f"Report   {result['report']}", soft_wrap=True)
    console.print(f"Next: syntopic verify {result['mission']}", soft_wrap=True)


def _print_geometry(console: Console, result: Mapping[str, Any]) -> None:
    geometry = light_table("Geometry against truth, PAN pixels", ("method",), ("RMS", "worst"))
    geometry.add_row("free mosaic, inner", *_pair(result["rms_px"], result["max_px"]))
    geometry.add_row(
        "free mosaic, absolute", *_pair(result["rms_px_absolute"], result["max_px_absolute"])
    )
    geometry.add_row("fixed method with TDM, inner", *_pair(result["rms_px_fixed"], None))
    geometry.add_row("fixed method without TDM, inner", *_pair(result["rms_px_no_tdm"], None))
    console.print(geometry)
    console.print(f"Displaced sensor found: {result['displaced_sensor'] or 'none'}")


def _pair(rms: float | None, worst: float | None) -> tuple[str, str]:
    return (_number(rms, ".4f"), _number(worst, ".3f"))
