"""Memory of the operator's page over a replay of thousands of exposures, in headless Chromium.

The events of the service go to the real process of the page, without a pipeline, and with each
exposure the frames of guidance until the next one, as many as come at 5 Hz. Four exposures a second
are as fast as that process passes these frames on: 5,000 exposures take 21 minutes. With
`--in-page` the page gets its files from that process and its records from itself, ten exposures in
each: what it holds is the same without guidance, and 5,000 exposures take two minutes. Memory is
that of the renderer: heap of JavaScript after a collection of garbage, PSS, and PSS after the
browser has emptied its caches, as it does when memory is short. Run: `python -m
benchmarks.page_memory --exposures 5000`.
"""

from __future__ import annotations

import argparse
import base64
import importlib
import json
import math
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

LINE_EXPOSURES: Final = 50
SPACING_DEG: Final = 6e-4
RATE_MAX_HZ: Final = 4.0
SEEN_TIMEOUT_S: Final = 120.0
GUIDANCE_HZ: Final = 5
EXPOSURE_INTERVAL_S: Final = 2.4
PER_RECORD: Final = 10
REPLAYED_AT_ONCE: Final = 100
VERDICTS: Final = ("good",) * 90 + ("usable",) * 9 + ("refly",)


DRAWN: Final = (
    "import('/guidance.js').then(({onGuidance}) => {"
    " window.guided = 0; onGuidance(() => { window.guided += 1; }); })"
)
"""Counts the frames of guidance that the page draws, at most one in each frame of the screen."""


def lines(count: int) -> dict[str, Any]:
    """A plan of parallel lines for so many exposures."""
    length_deg = SPACING_DEG * LINE_EXPOSURES
    features = [
        {
            "type": "Feature",
            "properties": {"id": f"A{k}", "strip": f"S{k}"},
            "geometry": {
                "type": "LineString",
                "coordinates": [
                    [15.43 + 0.003 * k, 47.07],
                    [15.43 + 0.003 * k, 47.07 + length_deg],
                ],
            },
        }
        for k in range(-(-count // LINE_EXPOSURES))
    ]
    return {"type": "FeatureCollection", "features": features}


def events_of(number: int, flight_events: Any) -> Iterator[dict[str, Any]]:
    """An exposure from its trigger to its verdict, and the status after it."""
    line, index = divmod(number - 1, LINE_EXPOSURES)
    along = index if line % 2 == 0 else LINE_EXPOSURES - 1 - index
    here = {
        "latitude_deg": 47.07 + SPACING_DEG * along,
        "longitude_deg": 15.43 + 0.003 * line,
    }
    verdict = VERDICTS[number % len(VERDICTS)]
    for event in flight_events.exposure(number, verdict, line=f"A{line}"):
        if event["event"] == "sealed":
            event["navigation"] = flight_events.NAVIGATION | here
        if event["event"] == "processed":
            figures = {"sigma0_px": 0.01 + 0.001 * (number % 7), "dc_estimated_k": 11.7}
            event["report"]["figures"] |= figures
            event["report"]["valid_area"] = {"share": 0.99, "rings": []}
        yield event
    status = flight_events.status("flying", number, 10_000 - number)
    flown = [f"A{k}" for k in range(line)]
    planned = {"flown": flown, "current": f"A{line}", "next": f"A{line + 1}"}
    position = here | {"age_s": 0.1, "satellites": 17, "fix": "3d"}
    yield status | {"position": position, "lines": planned}


def guidance_of(number: int, frames: Any) -> Iterator[dict[str, Any]]:
    """Frames of guidance from an exposure to the next one."""
    line, index = divmod(number - 1, LINE_EXPOSURES)
    ends = {
        one["properties"]["id"]: one["geometry"]["coordinates"][:: -1 if k % 2 else 1]
        for k, one in enumerate(lines((line + 2) * LINE_EXPOSURES)["features"])
        if k >= line
    }
    count = round(GUIDANCE_HZ * EXPOSURE_INTERVAL_S)
    for k in range(count):
        share = (index + k / count) / LINE_EXPOSURES
        yield frames.guidance_frame(ends, share, east_deg=2e-5 * math.sin(number + k / count))


def pss_mb(pid: int) -> float:
    """Proportional set size of a process, MB."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024 / 1e6
    return 0.0


def processes_below(pid: int) -> dict[int, str]:
    """Process ids of the children of a process, and theirs, with their command lines."""
    parents: dict[int, tuple[int, str]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
            parents[int(entry.name)] = parent, command
    found, frontier = {pid: parents[pid][1]}, {pid}
    while frontier:
        frontier = {child for child, (parent, _) in parents.items() if parent in frontier}
        found |= {child: parents[child][1] for child in frontier}
    return found


def sample(browser: Any, number: int) -> dict[str, Any]:
    """Memory of the page after collections of garbage; the least of three has nothing pending."""
    readings = []
    for _ in range(3):
        for _ in range(2):
            browser.call("HeapProfiler.collectGarbage")
        metrics = browser.call("Performance.getMetrics")["metrics"]
        readings.append({one["name"]: one["value"] for one in metrics})
        time.sleep(1.0)
    values = min(readings, key=lambda one: one["JSHeapUsedSize"])
    below = processes_below(browser._process.pid)
    renderers = [pid for pid, command in below.items() if "--type=renderer" in command]
    as_is_mb = max(pss_mb(pid) for pid in renderers)
    # Caches of pictures and of the allocator, which the browser empties when memory is short.
    browser.call("Memory.simulatePressureNotification", level="critical")
    time.sleep(1.0)
    return {
        "exposures": number,
        "heap_mb": round(values["JSHeapUsedSize"] / 1e6, 2),
        "nodes": int(values["Nodes"]),
        "renderer_mb": round(as_is_mb, 1),
        "renderer_purged_mb": round(max(pss_mb(pid) for pid in renderers), 1),
        "browser_mb": round(sum(pss_mb(pid) for pid in below), 1),
    }


def replay_script(exposures: int) -> str:
    """Script of a page that replays a flight to itself; `replayTo` leads it."""
    import cv2

    cockpit = importlib.import_module("tests.daemon.onboard.monitoring.cockpit")
    pictures = {"thumbnail": cv2.resize(cockpit.picture_of(1), (200, 133))}
    pictures["quicklook"] = cockpit.picture_of(2)
    replay: dict[str, Any] = {
        name: base64.b64encode(cv2.imencode(".jpg", one)[1].tobytes()).decode()
        for name, one in pictures.items()
    }
    planned = [
        {
            "id": one["properties"]["id"],
            "at": [[y, x] for x, y in one["geometry"]["coordinates"]],
            "places_m": [66.7 * k for k in range(LINE_EXPOSURES)],
        }
        for one in lines(exposures)["features"]
    ]
    replay["plan"] = {"name": "", "lines": planned, "specification": {}}
    script = Path(str(cockpit.__file__)).with_name("replayed_flight.js").read_text()
    return f"window.replay = {json.dumps(replay)};\n{script}"


def measure_in_page(exposures: int, samples: int) -> dict[str, Any]:
    """Let the page replay a flight to itself, and sample."""
    browser_of = importlib.import_module("tests.support.browser").Browser
    service_of = importlib.import_module("tests.daemon.onboard.monitoring.page_service").Service
    folder = Path(tempfile.mkdtemp(prefix="page-memory"))
    found: list[dict[str, Any]] = []
    service = service_of(folder)
    try:
        with browser_of(folder / "profile", width=1280, height=800) as browser:
            for domain in ("Performance", "HeapProfiler"):
                browser.call(f"{domain}.enable")
            browser.call("Network.disable")
            script = replay_script(exposures)
            browser.call("Page.addScriptToEvaluateOnNewDocument", source=script)
            browser.open(service.address)
            browser.wait_for("document.body?.dataset.ready !== undefined", SEEN_TIMEOUT_S)
            reached = 0
            step = max(1, exposures // samples)
            while reached < exposures:
                wanted = min(reached + REPLAYED_AT_ONCE, reached - reached % step + step)
                reached = browser.evaluate(f"replayTo({wanted}, {PER_RECORD})")
                if reached % step == 0:
                    time.sleep(2.0)
                    found.append(sample(browser, reached))
                    print(json.dumps(found[-1]), file=sys.stderr, flush=True)
            held = browser.evaluate(
                "import('/map.js').then((map) => [map.footprintCount(), map.planShown().areas])"
            )
    finally:
        service.end()
        shutil.rmtree(folder, ignore_errors=True)
    return {"samples": found, "growth_second_half_percent": growth_of(found), "held": held}


def growth_of(found: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Growth of each figure over the second half of a flight, percent."""
    names = ("heap_mb", "nodes", "renderer_mb", "renderer_purged_mb")
    return {name: growth_percent([one[name] for one in found]) for name in names}


def measure(exposures: int, samples: int) -> dict[str, Any]:
    """Replay and sample; afterwards the page is loaded again from the state of the service."""
    from daemon.configuration.model import WatchSection
    from daemon.onboard.service.messages import ServiceEvent
    from daemon.onboard.service.processes import ChildProcess

    # The types of tests are checked on their own.
    browser_of = importlib.import_module("tests.support.browser").Browser
    flight_events = importlib.import_module("tests.daemon.onboard.monitoring.flight_events")
    frames = importlib.import_module("tests.daemon.onboard.monitoring.guidance_frames")
    scene = importlib.import_module("tests.daemon.onboard.monitoring.test_page_guidance")
    folder = Path(tempfile.mkdtemp(prefix="page-memory"))
    mission = folder / "mission"
    (mission / "L0").mkdir(parents=True)
    scene.write_products(mission)
    names = ("thumbnail.jpg", "quicklook.jpg", "residuals.json", "histogram.json")
    for number in range(7, exposures + 1):
        copied = mission / f"L2/{number:06d}"
        copied.mkdir()
        for name in names:
            product = mission / f"L2/{1 + number % 6:06d}" / name
            if product.exists():
                os.link(product, copied / name)
    rig = scene.shipped_rigs()["ultracam-x-mini"].read_bytes()
    (mission / "rig.toml").write_bytes(rig)
    (mission / "plan.geojson").write_text(json.dumps(lines(exposures)))
    (mission / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    child = ChildProcess(
        "watch",
        "daemon.onboard.monitoring.monitoring_process:main",
        (WatchSection(host="127.0.0.1", port=0, announce=False),),
        {},
    )
    address = ""
    while not address:
        message = child.connection.recv()
        if isinstance(message, ServiceEvent) and message.event.get("event") == "watching":
            address = f"http://127.0.0.1:{message.event['port']}/"

    def emit(event: dict[str, Any]) -> None:
        while not child.try_send(ServiceEvent(event)):
            time.sleep(0.005)

    seen = "document.querySelector('#verdict .which')?.textContent.match(/\\d+/)?.[0] === '{}'"
    found: list[dict[str, Any]] = []
    emit(flight_events.mission(str(mission)))
    try:
        with browser_of(folder / "profile", width=1280, height=800) as browser:
            for domain in ("Performance", "HeapProfiler"):
                browser.call(f"{domain}.enable")
            # The protocol's network domain keeps every response in the renderer.
            browser.call("Network.disable")
            browser.open(address)
            browser.wait_for("document.querySelector('#link')?.className.includes('good')", 60)
            step = max(1, exposures // samples)
            browser.evaluate(DRAWN)
            for number in range(1, exposures + 1):
                begin_s = time.monotonic()
                for event in events_of(number, flight_events):
                    emit(event)
                guidance = list(guidance_of(number, frames))
                for k, frame in enumerate(guidance, 1):
                    emit(frame)
                    due_s = begin_s + k / (len(guidance) * RATE_MAX_HZ)
                    time.sleep(max(0.0, due_s - time.monotonic()))
                if number % step == 0:
                    browser.wait_for(seen.format(number), SEEN_TIMEOUT_S)
                    time.sleep(2.0)
                    drawn = browser.evaluate("window.guided")
                    found.append(sample(browser, number) | {"guidance_drawn": drawn})
                    print(json.dumps(found[-1]), file=sys.stderr, flush=True)
            browser.requested.clear()
            browser.open(address)
            browser.wait_for(seen.format(exposures), SEEN_TIMEOUT_S)
            time.sleep(5.0)
            again = sample(browser, exposures)
            again["footprints"] = browser.evaluate(
                "import('/map.js').then((map) => map.footprintCount?.() ?? null)"
            )
    finally:
        child.end(1.0)
        shutil.rmtree(folder, ignore_errors=True)
    return {"samples": found, "growth_second_half_percent": growth_of(found), "loaded_again": again}


def growth_percent(values: Sequence[float]) -> float:
    """Growth over the second half of a flight.

    Args:
        values: samples at equal intervals, the last at the end.

    Returns:
        Median of the last three over the median of the three in the middle, less one, in percent.

    Example:
        >>> growth_percent([10.0, 20.0, 20.0, 21.0, 22.0, 22.0])
        10.0
    """
    middle = len(values) // 2 - 1
    before = statistics.median(values[max(0, middle - 1) : middle + 2])
    return round(100 * (statistics.median(values[-3:]) / before - 1), 1)


def main() -> int:
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exposures", type=int, default=5000, help="default: 5000")
    parser.add_argument("--samples", type=int, default=20, help="default: 20")
    parser.add_argument("--in-page", action="store_true", help="the page replays it to itself")
    given = parser.parse_args()
    measured = measure_in_page if given.in_page else measure
    print(json.dumps(measured(given.exposures, given.samples), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
