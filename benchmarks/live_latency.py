"""`python -m benchmarks.live_latency`: verdicts with the live triangulation off and on, in turn.

Emulated heads render overlapping ground while the service captures, stores and processes as in
flight. Every pair is one flight without and one with the triangulation and its orthomosaic; in each
pair the order changes. With `--kill`, the process of the triangulation is killed (SIGKILL) in each
flight that has one, once half of the exposures have a verdict.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from daemon.cli.benchmark.measurement import machine
from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments

WITHIN_S = 600.0
TARGET = "triangulation"
ON = """
[triangulation]
enabled = true
landing_timeout_s = 120.0
"""


def fly(
    folder: Path, scenes: Path, rig: str, count: int, *, is_on: bool, kills: bool
) -> dict[str, Any]:
    """One flight: seconds from each trigger to its verdict, the ledger, and what was killed."""
    folder.mkdir(parents=True)
    arguments = simulator_arguments(rig, folder / "sim", seed=4, dc=0, displace=[])
    arguments += ["--first-address", free_first_address(), "--exposures", str(count)]
    emulator = Emulator([*arguments, "--scene-cache", str(scenes)])
    try:
        text = service_toml(emulator.ready, root="missions", count=count, end_when_done=True)
        config = folder / "service.toml"
        config.write_text(text + (ON if is_on else ""))
        return _watched(config, count, kills=kills and is_on)
    finally:
        emulator.end()


def _watched(config: Path, count: int, *, kills: bool) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.capture_service", str(config), "--pipeline"]
    service = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    triggered: dict[int, int] = {}
    verdict_s: dict[int, float] = {}
    found: dict[str, Any] = {"failures": [], "killed": 0, "triangulated": 0, "map_images": 0}
    pids: dict[str, int] = {}
    deadline = time.monotonic() + WITHIN_S
    assert service.stdout is not None
    try:
        for line in service.stdout:
            event = json.loads(line)
            kind = event["event"]
            if kind == "processes":
                pids = event["pids"]
            elif kind == "triggered":
                triggered[event["number"]] = int(event["mono_ns"])
            elif kind == "processed":
                number = event["number"]
                verdict_s[number] = (int(event["mono_ns"]) - triggered[number]) * 1e-9
                if kills and len(verdict_s) == count // 2:
                    os.kill(pids[TARGET], signal.SIGKILL)
                    found["killed"] += 1
            elif kind == "triangulation":
                found["triangulated"] = event["exposures"]
                found["adjusted_s"] = event["block_seconds"]
            elif kind == "orthomosaic":
                found["map_images"] = event["images"]
            elif kind == "triangulation-failed":
                found["failures"].append(event["sentence"])
            elif kind == "ended":
                found["ledger"] = event["ledger"]
            if time.monotonic() > deadline:
                raise TimeoutError(f"the flight is not over in {WITHIN_S:g} s")
    finally:
        if service.poll() is None:
            service.terminate()
    service.wait(30)
    return {**found, "verdict_s": verdict_s}


def figures(flights: list[dict[str, Any]]) -> dict[str, Any]:
    """Median and 99th percentile of all verdicts, and what was lost."""
    seconds = np.array([s for one in flights for s in one["verdict_s"].values()])
    triggers = [one["ledger"]["triggers"] for one in flights]
    return {
        "flights": len(flights),
        "triggers": sum(one["triggers"] for one in triggers),
        "lost": sum(one["lost"] for one in triggers),
        "is_balanced": all(one["ledger"]["balanced"] for one in flights),
        "verdicts": len(seconds),
        "median_s": float(np.median(seconds)),
        "p99_s": float(np.percentile(seconds, 99)),
        "medians_s": [float(np.median(list(one["verdict_s"].values()))) for one in flights],
        "triangulated": [one["triangulated"] for one in flights],
        "map_images": [one["map_images"] for one in flights],
        "killed": sum(one["killed"] for one in flights),
        "failures": [sentence for one in flights for sentence in one["failures"]],
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live_latency", description=__doc__)
    parser.add_argument("--rig", default="ultracam-l-mini")
    parser.add_argument("--exposures", type=int, default=20, help="of each flight")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--kill", action="store_true", help="kill the triangulation in flight")
    options = parser.parse_args()
    flights: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as temporary:
        folder = Path(temporary)
        for pair in range(options.pairs):
            for is_on in (False, True) if pair % 2 == 0 else (True, False):
                name = f"{pair}-{'on' if is_on else 'off'}"
                flown = fly(
                    folder / name, folder / "scenes", options.rig, options.exposures,
                    is_on=is_on, kills=options.kill,
                )  # fmt: skip
                flights[is_on].append(flown)
                print(name, json.dumps(figures([flown])), file=sys.stderr, flush=True)
    found = {"off": figures(flights[False]), "on": figures(flights[True])}
    print(json.dumps({"machine": machine(), "rig": options.rig, "figures": found}, indent=1))


if __name__ == "__main__":
    main()
