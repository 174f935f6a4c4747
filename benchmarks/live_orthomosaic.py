"""`python -m benchmarks.live_orthomosaic`: the orthomosaic in flight, its delay, bytes and memory.

Lines flown there and back are rendered as the ideal camera sees them, with shot noise and errors of
navigation. The process of the live triangulation receives one exposure after the other at the frame
interval, as the service sends them. `--exposures-in-memory` instead lays one picture along many
lines and measures memory of the map alone, and time of its last levelling and of its files.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from daemon.cli.benchmark.measurement import machine
from daemon.configuration.model import TriangulationSection
from daemon.onboard.live_orthomosaic.delivery import (
    COG_FILE,
    PMTILES_FILE,
    write_cog,
    write_map,
)
from daemon.onboard.live_orthomosaic.live_orthomosaic import LiveOrthomosaic
from daemon.onboard.live_orthomosaic.map_ground import PlaneGround
from daemon.onboard.live_orthomosaic.tile_files import TileFiles
from daemon.onboard.service.messages import (
    FinishTriangulation,
    ServiceEvent,
    Stop,
    TriangulateExposure,
    TriangulationFinished,
)
from daemon.onboard.service.processes import ChildProcess
from daemon.onboard.service.triangulation_link import TARGET
from daemon.orientation.local_frame import LocalFrame
from daemon.products.processing_threads import thread_counts
from processing.pipelines.live_triangulation import LiveOrientation, MeasuredImage
from processing.rig import load_rig, shipped_rigs
from tests.daemon.flown_block import flown_block

INTERVAL_S = 1.35
LIMIT_S = 600.0


def fly(folder: Path, rig: str, each: int, lines: int) -> dict[str, Any]:
    """Send the exposures of a rendered mission to the process; its delays, bytes and memory."""
    flown = flown_block(folder, each, lines, rig=rig)
    mission, count = flown.mission, each * lines
    hidden = folder / "later"
    (mission / "L2").rename(hidden)
    (mission / "L2").mkdir()
    section = TriangulationSection(enabled=True, landing_timeout_s=LIMIT_S)
    child = ChildProcess("triangulation", TARGET, (mission, section), thread_counts(1))
    pid = child.process.pid
    sent: dict[int, float] = {}
    events: list[tuple[float, dict[str, Any]]] = []
    finished: list[tuple[float, TriangulationFinished]] = []

    def receive(until_s: float) -> None:
        while (left := until_s - time.monotonic()) > 0.0 and not finished:
            if child.connection.poll(min(left, 0.1)):
                for message in child.receive():
                    now = time.monotonic()
                    if isinstance(message, ServiceEvent):
                        events.append((now, dict(message.event)))
                    elif isinstance(message, TriangulationFinished):
                        finished.append((now, message))

    try:
        receive(time.monotonic() + 20.0)  # its kernels are loaded
        for number in range(1, count + 1):
            (hidden / f"{number:06d}").rename(mission / f"L2/{number:06d}")
            sent[number] = time.monotonic()
            child.send(TriangulateExposure(number))
            receive(sent[number] + INTERVAL_S)
        landed = time.monotonic()
        child.send(FinishTriangulation())
        receive(landed + LIMIT_S)
        status = Path(f"/proc/{pid}/status").read_text()
        cpu = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        child.send(Stop())
        child.process.join(20.0)
    finally:
        child.end(1.0)
    peak_kb = next(int(line.split()[1]) for line in status.splitlines() if "VmHWM" in line)
    own = {e["number"]: (at, e) for at, e in events if e["event"] == "orthomosaic" and
           "number" in e}  # fmt: skip
    delays = np.array([own[n][0] - sent[n] for n in sent if n in own])
    sizes = np.array([sum(t[4] for t in e["tiles"]) for _, e in own.values()])
    seconds = np.array([e["seconds"] for _, e in own.values()])
    levelled_bytes = [sum(t[4] for t in e["tiles"]) for _, e in events
               if e["event"] == "orthomosaic" and "number" not in e]  # fmt: skip
    folder_of_map = mission / "export/live-orthomosaic"
    return {
        "rig": rig,
        "exposures": count,
        "lines": lines,
        "in_map": len(own),
        "gsd_m": next(iter(own.values()))[1]["gsd_m"],
        "delay_s": _spread(delays),
        "map_seconds": _spread(seconds),
        "bytes_of_an_exposure": _spread(sizes),
        "bytes_at_ends_of_lines": levelled_bytes,
        "landing_s": finished[0][0] - sent[count],
        "is_written": finished[0][1].is_written,
        "peak_mb": peak_kb / 1024.0,
        "cpu_s": sum(int(v) for v in cpu[11:13]) / 100.0,
        "cog_bytes": (folder_of_map / "orthomosaic.tif").stat().st_size,
        "pmtiles_bytes": (folder_of_map / "orthomosaic.pmtiles").stat().st_size,
    }


def remember(folder: Path, rig_name: str, count: int, each: int = 100) -> dict[str, Any]:
    """Lay one picture along many lines; memory of the map, before and after."""
    image = load_rig(shipped_rigs()[rig_name]).virtual_image
    assert image is not None
    above_m = 1000.0
    frame = LocalFrame(47.0, 15.0)
    live = LiveOrthomosaic(TileFiles(folder), image, frame, PlaneGround(47.0, 15.0, 0.0))
    random = np.random.default_rng(1)
    shape = (image.height_px, image.width_px)
    pixels = (8000.0 + random.normal(0.0, 400.0, shape)).astype(np.uint16)
    across = 0.7 * image.width_px * image.pitch_mm / image.f_mm * above_m
    along = 0.4 * image.height_px * image.pitch_mm / image.f_mm * above_m
    begun, seconds, orientations, memory = _resident_mb(), [], [], {}
    turn = np.diag([-1.0, -1.0, 1.0])
    for number in range(1, count + 1):
        line, at = divmod(number - 1, each)
        place = at if line % 2 == 0 else each - 1 - at
        position = np.array([line * across, place * along, above_m])
        rotation = np.eye(3) if line % 2 == 0 else turn
        nothing = np.zeros(3)
        measured = MeasuredImage(
            number, f"{line}", 0.0, position, rotation, nothing, nothing, nothing
        )
        one = LiveOrientation(measured, position, rotation, np.eye(6), "block", 40)
        orientations.append(one)
        before = time.perf_counter()
        live.add(one, pixels, orientations)
        if at == each - 1:
            live.level(orientations, live.ground)
            live.publish_levelled()
        seconds.append(time.perf_counter() - before)
        if number % (count // 5) == 0:
            memory[str(number)] = _resident_mb() - begun
    landing_s, cpu = [time.perf_counter()], [time.process_time()]
    for name in (names := ("level", "cog", "pmtiles")):
        if name == "level":
            live.level(orientations, live.ground)
            live.publish_levelled()
        elif name == "cog":
            write_cog(live, folder / COG_FILE, {})
        else:
            write_map(live, folder / PMTILES_FILE, {})
        landing_s.append(time.perf_counter())
        cpu.append(time.process_time())
    return {
        "landing_s": dict(zip(names, np.diff(landing_s).tolist(), strict=True)),
        "landing_cpu_s": dict(zip(names, np.diff(cpu).tolist(), strict=True)),
        "rig": rig_name,
        "exposures": count,
        "memory_mb": memory,
        "peak_of_process_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "seconds_of_an_exposure": _spread(np.array(seconds)),
        "tiles": len(live.files.states),
    }


def _resident_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return next(int(v.split()[1]) for v in status.splitlines() if "VmRSS" in v) / 1024.0


def _spread(values: np.ndarray[Any, Any]) -> dict[str, float]:
    return {
        "median": float(np.median(values)),
        "99": float(np.percentile(values, 99)),
        "max": float(values.max()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.live_orthomosaic", description=__doc__
    )
    parser.add_argument("--rig", default="ultracam-x-mini")
    parser.add_argument("--exposures", type=int, default=15, help="of each line")
    parser.add_argument("--lines", type=int, default=4)
    parser.add_argument("--exposures-in-memory", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as temporary:
        folder = Path(temporary)
        if options.exposures_in_memory:
            figures = remember(folder, options.rig, options.exposures_in_memory)
        else:
            figures = fly(folder, options.rig, options.exposures, options.lines)
    print(json.dumps({"machine": machine(), "figures": figures}))


if __name__ == "__main__":
    main()
