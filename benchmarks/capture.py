"""`python -m benchmarks.capture`: capture at full size, or with the pipeline (`--pipeline`).

Thirteen emulated GigE Vision heads send frames made beforehand; the service captures, matches,
hashes, stores and syncs them as in flight. `--pipeline` has it process them, too. What is verified
is deleted, so that the disk stays small; the product never does that.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from rich.table import Table

from benchmarks.ring_heads import RING, build_ring, is_intact, number_of
from benchmarks.switch import Switch, switch
from daemon.cli.benchmark import pipeline
from daemon.cli.benchmark.measurement import machine
from daemon.cli.sim import free_first_address
from daemon.mission.store.level0_folder import read_sealed
from daemon.terminal.console import Console
from processing.rig import Rig, find_rig

RETAINED_EXPOSURES = 6
"""Maximum exposures on disk: in writing, sealed and not yet checked, or spare."""
EXPOSURE_US = 4000.0
TICK_HZ = os.sysconf("SC_CLK_TCK")
READY_WITHIN_S = 300.0
GRACE_S = 120.0
PIPELINE_WITHIN_S = 40.0
"""What an exposure may take in the pipeline before the run is given up."""


class Retention:
    """Looks at sealed exposures and deletes them; a test's, never the product's.

    Every exposure is checked: each frame's number in its pixels against its record's count.
    Every `full_check_every`-th is read whole: the record's hash of each file, and the checksum that
    was in the pixels when they were made.
    """

    def __init__(self, full_check_every: int) -> None:
        self._full_check_every = full_check_every
        self.checked = 0
        self.fully_checked = 0
        self.problems: list[str] = []

    def take(self, folder: Path) -> None:
        """Verify and delete one exposure."""
        sealed = read_sealed(folder)
        if sealed is None:
            self.problems.append(f"{folder.name}: no record")
            return
        self.checked += 1
        is_full_check = (self.checked - 1) % self._full_check_every == 0
        self.fully_checked += is_full_check
        for frame in sealed.exposure.frames:
            path = folder / frame.file
            pixels = tifffile.memmap(path, mode="r")
            found = number_of(np.asarray(pixels[:1]))
            if found != frame.counter:
                self.problems.append(f"{folder.name}/{frame.file}: of {found}, not {frame.counter}")
            elif is_full_check and not is_intact(np.asarray(pixels)):
                self.problems.append(f"{folder.name}/{frame.file}: pixels differ")
            if is_full_check and hashlib.sha256(path.read_bytes()).hexdigest() != frame.sha256:
                self.problems.append(f"{folder.name}/{frame.file}: hash differs")
        shutil.rmtree(folder)


class CpuMeter:
    """CPU seconds of processes since they were first measured."""

    def __init__(self) -> None:
        self._pids: dict[str, int] = {}
        self._first: dict[str, float] = {}
        self.seconds: dict[str, float] = {}

    def watch(self, pids: Mapping[str, int]) -> None:
        self._pids |= pids
        self.sample()

    def sample(self) -> None:
        for name, pid in self._pids.items():
            try:
                text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
            except OSError:
                continue
            fields = text.rpartition(")")[2].split()
            used = (int(fields[11]) + int(fields[12])) / TICK_HZ
            self.seconds[name] = used - self._first.setdefault(name, used)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.capture", description=__doc__)
    parser.add_argument("--rig", default="ultracam-x")
    parser.add_argument("--exposures", type=int, default=500)
    parser.add_argument("--interval", type=float, help="s; the rig's own by default")
    parser.add_argument("--root", type=Path, help="where Level-0 goes (default: a folder in /tmp)")
    parser.add_argument("--noise", action="store_true", help="frames of noise, nothing rendered")
    parser.add_argument("--pipeline", action="store_true", help="process the exposures, too")
    parser.add_argument("--depth", type=int, default=3, help="exposures in memory")
    parser.add_argument("--packet-size", type=int, default=9000)
    parser.add_argument("--rate", type=float, default=40.0, help="MB/s of one head")
    parser.add_argument("--processes", type=int, default=2, help="of emulated heads")
    parser.add_argument(
        "--full-check-every",
        type=int,
        default=10,
        help="Interval of full checks, exposures (default: 10).",
    )
    parser.add_argument("--switch-mbps", type=float, help="a switch of this rate in between")
    parser.add_argument("--switch-buffer", type=int, default=131_072, help="of its port, bytes")
    parser.add_argument("--unpaced", action="store_true", help="no link budget for the heads")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    rig = find_rig(options.rig)
    with ExitStack() as resources:
        temporary = tempfile.TemporaryDirectory(prefix="syntopic-capture-", dir=options.root)
        folder = Path(resources.enter_context(temporary))
        between = None
        if options.switch_mbps:
            sizes = (options.switch_mbps, options.switch_buffer)
            between = resources.enter_context(switch(len(rig.sensors), *sizes))
        result = _run(options, rig, folder, between)
    if options.json:
        print(json.dumps(result))
    else:
        _print(result)
    sys.exit(0 if result["nothing_lost"] else 1)


def _run(
    options: argparse.Namespace, rig: Rig, folder: Path, between: Switch | None
) -> dict[str, Any]:
    exposure_nbytes = sum(2 * s.width_px * s.height_px for s in rig.sensors)
    # What the pipeline puts off waits on disk until it is done.
    retained = RETAINED_EXPOSURES + (options.exposures if options.pipeline else 0)
    _refuse_small_disk(folder, exposure_nbytes * retained)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "syntopic"
    ring = cache / "capture" / (f"{rig.name}-noise" if options.noise else rig.name)
    frames = place = None
    if not options.noise:
        place = pipeline.benchmark_exposure(options.rig, rig, cache / "bench" / rig.name)
        frames = place / "mission" / "L0" / "000001"
    _refuse_small_disk(cache, exposure_nbytes * RING)
    build_ring(options.rig, frames, ring)
    interval_s = options.interval or rig.frame_interval_s
    if between is None:
        block = free_first_address().rpartition(".")[0]
        addresses = {s.name: f"{block}.{2 + i}" for i, s in enumerate(rig.sensors)}
    else:
        addresses = {s.name: between.head_address(i) for i, s in enumerate(rig.sensors)}
    request = {
        "rig": options.rig,
        "ring": str(ring),
        "addresses": addresses,
        "processes": options.processes,
        "rate_bytes_per_s": options.rate * 1e6,
    }
    if between is not None:
        request["bus_host"] = between.head_address(0)
    emulate = [sys.executable, "-m", "benchmarks.ring_heads", json.dumps(request)]
    emulator = subprocess.Popen(
        emulate if between is None else between.at_heads(emulate),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert emulator.stdout is not None
        bus = json.loads(emulator.stdout.readline())
        config = folder / "service.toml"
        text = _configuration(options, rig, addresses, bus, interval_s, place)
        config.write_text(text + _network(options, between))
        load_before = os.getloadavg()[0]
        flown = _fly(options, config, bus, interval_s, between)
        counted, _ = emulator.communicate(timeout=READY_WITHIN_S)
    finally:
        emulator.kill()
    found = _evaluate(
        options, rig, folder, flown, json.loads(counted), load_before, interval_s, exposure_nbytes
    )
    if between is not None:
        found["switch"] = {
            "rate_mbps": options.switch_mbps,
            "buffer_bytes": options.switch_buffer,
            "paced": not options.unpaced,
            "packets_dropped": between.dropped_packets(),
        }
    return found


def _network(options: argparse.Namespace, between: Switch | None) -> str:
    """The section of the link; the switch's port is slower than the interface reports."""
    if between is None:
        return ""
    lines = [
        "[network]",
        f"link_mbps = {{ {between.interface} = {options.switch_mbps} }}",
        f"switch_buffer_bytes = {options.switch_buffer}",
        f"is_paced = {json.dumps(not options.unpaced)}",
    ]
    return "\n".join(lines) + "\n"


def _refuse_small_disk(folder: Path, needed: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < needed + 1_000_000_000:
        raise SystemExit(f"{folder}: {needed / 1e9:.1f} GB and 1 GB spare are needed, free {free}")


def _configuration(
    options: argparse.Namespace,
    rig: Rig,
    addresses: Mapping[str, str],
    bus: Mapping[str, Any],
    interval_s: float,
    place: Path | None,
) -> str:
    calibrated = options.pipeline and place is not None
    radiometry = place / "calibration" / "radiometry" if calibrated and place else None
    lines = [
        "[mission]",
        'root = "missions"',
        f"rig = {json.dumps(options.rig)}",
        "simulated = true",
        "end_when_done = true",
        *([f"radiometry = {json.dumps(str(radiometry))}"] if radiometry else []),
        "[processing]",
        "geometry = false",
        "[trigger]",
        'driver = "pulse-bus"',
        f"host = {json.dumps(bus['host'])}",
        f"port = {bus['port']}",
        f"interval_s = {interval_s}",
        f"count = {options.exposures}",
        "[limits]",
        "mark_timeout_s = 0.1  # there is no receiver to wait for",
        f"exposures_in_memory = {options.depth}",
    ]
    for sensor in rig.sensors:
        lines += [
            "[[head]]",
            f"sensor = {json.dumps(sensor.name)}",
            'driver = "aravis"',
            f"address = {json.dumps(addresses[sensor.name])}",
            f"exposure_time_us = {EXPOSURE_US}",
            f"packet_size = {options.packet_size}",
        ]
    return "\n".join(lines) + "\n"


def _fly(
    options: argparse.Namespace,
    config: Path,
    bus: Mapping[str, Any],
    interval_s: float,
    between: Switch | None,
) -> dict[str, Any]:
    """Run the service to its end while checking what it stores; returns its output."""
    processor, retention = CpuMeter(), Retention(options.full_check_every)
    flown: dict[str, Any] = {"events": [], "store_s": [], "delay_s": [], "ledger": {}}
    flown |= {"processed": []}
    triggered_ns: dict[int, int] = {}
    fly = [sys.executable, "-m", "benchmarks.capture_service", str(config)]
    fly += ["--pipeline"] if options.pipeline else []
    service = subprocess.Popen(
        fly if between is None else between.at_computer(fly),
        stdout=subprocess.PIPE,
        text=True,
    )
    limit_s = READY_WITHIN_S + options.exposures * interval_s + GRACE_S
    if options.pipeline:
        limit_s += options.exposures * PIPELINE_WITHIN_S
    killer = threading.Timer(limit_s, service.kill)
    killer.start()
    level0 = config.parent
    children: dict[str, int] = {}
    try:
        assert service.stdout is not None
        for line in service.stdout:
            event = json.loads(line)
            name, now_ns = event["event"], int(event["mono_ns"])
            if name == "mission":
                level0 = Path(event["path"]) / "L0"
            elif name == "processes":
                children = event["pids"]
            elif name == "ready":
                heads = {f"heads {i + 1}": pid for i, pid in enumerate(bus["pids"])}
                processor.watch({"service": service.pid, **children, **heads})
                flown["absent"] = event["absent"]
                flown["started_s"] = time.monotonic()
            elif name == "triggered":
                triggered_ns[event["number"]] = now_ns
            elif name == "stored":
                flown["store_s"].append(event["duration_s"])
                flown["delay_s"].append((now_ns - triggered_ns[event["number"]]) * 1e-9)
            elif name == "sealed":
                processor.sample()
                flown["seconds"] = time.monotonic() - flown["started_s"]
                if not options.pipeline:
                    retention.take(level0 / f"{event['number']:06d}")
            elif name in ("processed", "not-processed"):
                processor.sample()
                flown["processed_seconds"] = time.monotonic() - flown["started_s"]
                flown["processed"].append(_processed(event, now_ns, triggered_ns))
                retention.take(level0 / f"{event['number']:06d}")
                shutil.rmtree(level0.parent / "L2" / f"{event['number']:06d}", ignore_errors=True)
            elif name == "ended":
                flown["ledger"] = event["ledger"]
            elif name in ("lost", "not-written", "fault") or event.get("fault"):
                flown["events"].append(event)
        flown["status"] = service.wait(GRACE_S)
    finally:
        killer.cancel()
        service.kill()
    flown["cpu_s"] = processor.seconds
    flown["retention"] = retention
    return flown


def _processed(
    event: Mapping[str, Any], now_ns: int, triggered_ns: Mapping[int, int]
) -> dict[str, Any]:
    """What became of one exposure in the pipeline."""
    report = event.get("report")
    return {
        "done": report is not None,
        "behind": report is not None and "PROCESSING_BEHIND" in report["flags"],
        "pipeline_s": event.get("duration_s", 0.0),
        "trigger_to_products_s": (now_ns - triggered_ns[event["number"]]) * 1e-9,
    }


def _of_pipeline(flown: Mapping[str, Any], interval_s: float) -> dict[str, Any]:
    """Pace and latency of the pipeline during capture; empty where it did not run."""
    all_of_them = flown["processed"]
    done = [one for one in all_of_them if one["done"]]
    if not done:
        return {}
    return {
        "processed": len(done),
        "not_processed": len(all_of_them) - len(done),
        "behind": sum(one["behind"] for one in done),
        "seconds": flown["processed_seconds"],
        "realtime_factor": interval_s * len(done) / flown["processed_seconds"],
        "pipeline_s": _spread([one["pipeline_s"] for one in done]),
        "trigger_to_products_s": _spread([one["trigger_to_products_s"] for one in done]),
    }


def _evaluate(
    options: argparse.Namespace,
    rig: Rig,
    folder: Path,
    flown: Mapping[str, Any],
    counted: Mapping[str, Mapping[str, int]],
    load_before: float,
    interval_s: float,
    exposure_nbytes: int,
) -> dict[str, Any]:
    retention: Retention = flown["retention"]
    wanted = options.exposures
    ledger = flown["ledger"]
    triggers, frames = ledger.get("triggers", {}), ledger.get("frames", {})
    complete = triggers.get("complete", 0)
    sent = {name: head["frames_sent"] for name, head in counted.items()}
    exposed = {name: head["frames_exposed"] for name, head in counted.items()}
    resent = sum(head["packets_resent"] for head in counted.values())
    seconds = flown.get("seconds", 0.0)
    nothing_lost = (
        complete == wanted
        and frames.get("used") == wanted * len(rig.sensors)
        and bool(ledger.get("balanced"))
        and set(sent.values()) == {wanted}
        and set(exposed.values()) == {wanted}
        and len(sent) == len(rig.sensors)
        and retention.checked == wanted
        and not retention.problems
    )
    return {
        "machine": machine(),
        "load_before": load_before,
        "load_after": os.getloadavg()[0],
        "rig": rig.name,
        "frames": "noise" if options.noise else "pre-rendered",
        "interval_s": interval_s,
        "exposures": wanted,
        "seconds": seconds,
        "mb_per_s": exposure_nbytes * complete / 1e6 / seconds if seconds else 0.0,
        "packet_size": options.packet_size,
        "exposures_in_memory": options.depth,
        "file_system": _file_system(folder),
        "nothing_lost": nothing_lost,
        "triggers": triggers,
        "frames_of_ledger": frames,
        "frames_exposed": sum(exposed.values()),
        "frames_sent": sum(sent.values()),
        "packets_sent": sum(head["packets_sent"] for head in counted.values()),
        "packets_resent": resent,
        "checked": retention.checked,
        "fully_checked": retention.fully_checked,
        "problems": retention.problems[:20],
        "events": flown["events"][:20],
        "cpu_s": flown["cpu_s"],
        "cpu_s_per_exposure": {k: s / wanted for k, s in flown["cpu_s"].items()},
        "store_s": _spread(flown["store_s"]),
        "trigger_to_stored_s": _spread(flown["delay_s"]),
        "pipeline": _of_pipeline(flown, interval_s),
    }


def _file_system(folder: Path) -> str:
    """The kind of file system of a folder."""
    found = subprocess.run(
        ["stat", "-f", "-c", "%T", folder], capture_output=True, text=True, timeout=10, check=False
    )
    return found.stdout.strip()


def _spread(seconds: list[float]) -> dict[str, float]:
    """Median, 95th percentile, least and largest; nothing without values."""
    if not seconds:
        return {}
    median, p95 = np.quantile(seconds, (0.5, 0.95)).tolist()
    return {"median": median, "p95": p95, "min": min(seconds), "max": max(seconds)}


def _counted(figures: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in figures.items() if key != "name")


def _print(result: Mapping[str, Any]) -> None:
    console = Console()
    m = result["machine"]
    console.print(
        f"{m['date']}  {m['processor']}, {m['cores']} cores, {m['memory_gib']} GiB, load "
        f"{result['load_before']:.1f} before, {result['load_after']:.1f} after"
    )
    console.print(
        f"{result['rig']}, {result['frames']} frames, {result['exposures']} exposures every "
        f"{result['interval_s']} s: {result['mb_per_s']:.0f} MB/s over {result['seconds']:.0f} s, "
        f"on {result['file_system']}, {result['exposures_in_memory']} exposures in memory"
    )
    table = Table(title="CPU", title_justify="left")
    for heading in ("process", "s", "s per exposure", "of a core"):
        table.add_column(heading, justify="right")
    for name, seconds in result["cpu_s"].items():
        each = result["cpu_s_per_exposure"][name]
        share = seconds / max(result["seconds"], 1e-9)
        table.add_row(name, f"{seconds:.1f}", f"{each:.3f}", f"{share:.0%}")
    console.print(table)
    for what in ("store_s", "trigger_to_stored_s"):
        if result[what]:
            spread = result[what]
            middle = f"median {spread['median']:.2f}, 95 % below {spread['p95']:.2f}"
            console.print(f"{what}: {middle}, at most {spread['max']:.2f}")
    stats = result["pipeline"]
    if stats:
        console.print(
            f"pipeline: {stats['processed']} exposures in {stats['seconds']:.0f} s, "
            f"realtime_factor {stats['realtime_factor']:.2f}, {stats['behind']} deferred as "
            f"processing behind, {stats['not_processed']} failed; "
            f"{stats['pipeline_s']['median']:.2f} s each, "
            f"{stats['trigger_to_products_s']['median']:.1f} s from trigger to products "
            f"(95 % below {stats['trigger_to_products_s']['p95']:.1f} s)"
        )
    console.print(
        f"ledger: {_counted(result['triggers'])}; frames: {_counted(result['frames_of_ledger'])}"
    )
    console.print(
        f"heads exposed {result['frames_exposed']} frames, sent {result['frames_sent']}, "
        f"{result['packets_resent']} of {result['packets_sent']} packets twice; "
        f"{result['checked']} exposures checked, {result['fully_checked']} read completely"
    )
    if "switch" in result:
        console.print(f"switch: {_counted(result['switch'])}")
    for problem in (*result["problems"], *(str(event) for event in result["events"])):
        console.print(f"[red]{problem}[/]")
    console.print("nothing lost" if result["nothing_lost"] else "[bold red]something was lost[/]")


if __name__ == "__main__":
    main()
