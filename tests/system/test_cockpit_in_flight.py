"""The operator's page through a flight that is really flown, measured in each of its states.

The daemon runs as a process on a disk of its own; heads, receiver, probes and trigger unit are
emulated on the wire; the page is in Chromium. Each state is awaited, measured at three sizes and in
both themes, and must still be there after the measurement: otherwise it is awaited again, on the
next line. With SYNTOPIC_PICTURES a folder, each state is pictured there.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from daemon.onboard.monitoring.access.tokens import add_token
from daemon.planning.model import LocalPlane, Point
from processing.rig import shipped_rigs
from sim_hw.world.flight import FlightPlan
from sim_hw.world.world import World, WorldSettings
from tests.daemon.onboard.monitoring.cockpit import (
    SIZES,
    THEMES,
    faults_of_page,
    resize,
    save_picture,
)
from tests.daemon.onboard.monitoring.guidance_frames import aerial_map, vector_map
from tests.robustness.crash.test_full_disk import NAMESPACE, needs_namespace
from tests.support.browser import Browser, chromium
from tests.support.stopwatch import Stopwatch, slowdown
from tests.system.test_operators_page import Running

pytestmark = [needs_namespace, pytest.mark.system, pytest.mark.timeout(900)]

RIG = "ultracam-x-mini"
SPEED_MPS = 30.0
LINES = 6
PLACES = 6
"""Exposures of a line: 32 s; the turn after it takes 27 s."""
LINE_AHEAD_S = 55.0
"""From the start of the emulated devices to the start of the first line, where the machine is idle;
up to three times as much on a busy one."""
WITHIN_S = 180.0
LATER_S = 3600.0
MOUNT = (
    "mount -t tmpfs -o size=3g tmpfs /srv && mkdir /srv/missions /srv/ports"
    ' && mount --bind "$0" /srv/ports && exec "$@"'
)
"""A disk of the service alone, and the ports of the devices where those of a camera may be."""
DISK_LEFT_BYTES = 900_000_000
LIMITS = """
[limits]
disk_reserve_bytes = 100_000_000
disk_warn_exposures = 20
"""
LOST_HEAD = "SU03"

FLYING = (
    "document.querySelector('#phase-button').dataset.next === 'stop'"
    " && !document.body.classList.contains('connection-lost')"
    " && document.querySelectorAll('#strip .thumb img[src]').length > 0"
)


def shows(*keys: str) -> str:
    """Whether guidance has cells with these keys."""
    return " && ".join(f"document.querySelector('#guidance [data-key={k}]') !== null" for k in keys)


ON_A_LINE = f"({FLYING} && {shows('across', 'end')})"
BETWEEN_LINES = f"({FLYING} && {shows('bearing')})"


NIGHT = {
    *(("on-a-line", width) for width, _ in SIZES),
    *((state, 1280) for state in ("between-lines", "degraded")),
}
"""States and widths that are pictured in the dark theme as well."""


def is_lamp(name: str, *states: str) -> str:
    selector = ", ".join(f"#lamp-{name}.{state}" for state in states)
    return f"(document.querySelector('{selector}') !== null)"


DEGRADED = " && ".join(
    (
        is_lamp("heads", "warning"),
        is_lamp("position", "warning"),
        is_lamp("disk", "caution", "warning"),
        "document.querySelector('#guidance').classList.contains('lost')",
    )
)
LINK_LOST = "document.body.classList.contains('connection-lost')"
LANDED = "document.querySelector('#landing').checkVisibility()"


def flown_m(emulator: Emulator) -> float:
    """How far the aircraft has flown; north, until its first exposure."""
    return (time.monotonic_ns() - emulator.ready["mono_ns_at_line_start"]) * 1e-9 * SPEED_MPS


def block(north_m: float, step_m: float, spacing_m: float) -> dict[str, Any]:
    """Lines as the emulated aircraft flies them, from a place north of where it starts."""
    plane = LocalPlane(Point(FlightPlan.latitude_deg, FlightPlan.longitude_deg))
    features = []
    for k in range(LINES):
        ends_m = (north_m, north_m + (PLACES - 1) * step_m)[:: -1 if k % 2 else 1]
        ends = [plane.place(k * spacing_m, north) for north in ends_m]
        features.append(
            {
                "type": "Feature",
                "properties": {"id": f"A{k + 1}", "strip": f"S{k + 1}"},
                "geometry": {
                    "type": "LineString",
                    "coordinates": [[one.longitude_deg, one.latitude_deg] for one in ends],
                },
            }
        )
    specification = {"forward_overlap": 0.6, "sidelap": 0.3, "tilt_deg": 3.0, "sun_deg": 20.0}
    return {"type": "FeatureCollection", "features": features, "specification": specification}


@dataclass
class Flight:
    """The devices, the service on its disk, and a browser on its page."""

    emulator: Emulator
    service: Running
    browser: Browser
    disk: Path
    port: int
    first_line_m: float
    """Start of the first line, north of where the aircraft starts."""

    def until(self, script: str, within_s: float = WITHIN_S) -> None:
        self.browser.wait_for(script, within_s)

    def is_late(self) -> bool:
        """Whether the aircraft is past the start of the first line."""
        return flown_m(self.emulator) > self.first_line_m

    def event(self, kind: str, /, **content: Any) -> dict[str, Any]:
        """The first event with such a content."""
        return self.service.wait_for(
            lambda e: e["event"] == kind and content.items() <= e.items(), WITHIN_S
        )

    def fill_disk(self) -> None:
        """Leave so little of the disk of the mission that room is low."""
        usage = os.statvfs(self.disk)
        with (self.disk / "filler").open("wb") as filler:
            os.posix_fallocate(
                filler.fileno(), 0, usage.f_bavail * usage.f_frsize - DISK_LEFT_BYTES
            )

    def page_process(self) -> int:
        """Id of the process of the service that serves the page."""
        inode = None
        for line in Path(f"/proc/{self.service.process.pid}/net/tcp").read_text().splitlines()[1:]:
            fields = line.split()
            if int(fields[1].rpartition(":")[2], 16) == self.port and fields[3] == "0A":
                inode = f"socket:[{fields[9]}]"
        assert inode is not None
        task = Path(f"/proc/{self.service.process.pid}/task/{self.service.process.pid}/children")
        for pid in task.read_text().split():
            for fd in Path(f"/proc/{pid}/fd").iterdir():
                if str(fd.readlink()) == inode:
                    return int(pid)
        raise AssertionError("no process serves the page")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory, scenes: Path) -> Iterator[Flight]:
    chromium()
    folder = tmp_path_factory.mktemp("cockpit-in-flight")
    arguments = simulator_arguments(RIG, folder / "sim", seed=1, dc=4.0, displace=[])
    arguments += ["--scene-cache", str(scenes), "--exposures", str(PLACES)]
    arguments += ["--speed", str(SPEED_MPS), "--still", "--read-faults"]
    emulator = Emulator([*arguments, "--first-address", free_first_address()])
    service = None
    try:
        plan = emulator.ready["plan"]
        ahead_s = LINE_AHEAD_S * min(3.0, slowdown())
        north_m = flown_m(emulator) + ahead_s * SPEED_MPS
        spacing_m = World(
            WorldSettings(rig_file=str(shipped_rigs()[RIG]), seed=1, epoch_gps_ns=0)
        ).flight.plan.line_spacing_m
        (folder / "block.geojson").write_text(
            json.dumps(block(north_m, plan["distance_m"], spacing_m))
        )
        origin = (531_000.0, 5_212_500.0 + north_m + 2_000.0)
        maps = [str(aerial_map(folder, origin)), str(vector_map(folder))]
        ports = folder.resolve() / "sim/ports"
        text = service_toml(emulator.ready, root="/srv/missions", watch_port=0)
        text = text.replace(str(ports), "/srv/ports")
        text = text.replace('line = "1"', 'file = "block.geojson"')
        text = text.replace('mode = "distance"', 'mode = "plan"')
        text = text.replace("[trigger]\n", '[trigger]\nstart = "on command"\n')
        text = text.replace("[watch]\n", f"[watch]\nmaps = {json.dumps(maps)}\n")
        config = folder / "service.toml"
        config.write_text(text + LIMITS)
        token = add_token(folder / "tokens.toml", "operator", "administrator")
        service = Running(config, [*NAMESPACE, "sh", "-c", MOUNT, str(ports)])
        watching = service.wait_for(lambda e: e["event"] == "watching", WITHIN_S)
        with Browser(folder / "profile", width=1280, height=800) as browser:
            browser.open(f"http://{watching['host']}:{watching['port']}/")
            browser.wait_for("document.querySelector('#link')?.innerText === 'connected'", 60)
            browser.evaluate(f"sessionStorage.setItem('token', {json.dumps(token)})")
            disk = Path(f"/proc/{service.process.pid}/root/srv")
            yield Flight(emulator, service, browser, disk, int(watching["port"]), north_m)
    finally:
        if service is not None and service.process.poll() is None:
            service.process.terminate()
            service.process.wait(60)
        emulator.end()


def check(
    flight: Flight, state: str, is_so: str, *, phone_tab: str = "map", seen: str = ""
) -> None:
    """Measure the page at each size and in each theme while it is in a state, and picture it."""
    browser, begun_s = flight.browser, time.monotonic()
    for width, height in SIZES:
        for theme in THEMES:
            watch = Stopwatch()
            is_measured = False
            while not is_measured:
                assert watch.is_within(2 * WITHIN_S), f"{state} is over before it is measured"
                flight.until(is_so)
                resize(browser, width, height, theme)
                found = faults_of_page(browser, width, phone_tab)
                if seen:
                    browser.evaluate(
                        f"document.querySelector('{seen}').scrollIntoView({{block: 'end'}})"
                    )
                if not theme or (state, width) in NIGHT:
                    save_picture(browser, f"{state}-{width}{'-night' if theme else ''}")
                is_measured = bool(browser.evaluate(is_so))
            assert found == [], f"{state} at {width}x{height} {theme or 'light'}: {found}"
    print(f"{state}: measured in {time.monotonic() - begun_s:.1f} s")
    resize(browser, *SIZES[0])


def test_before_arming(flight: Flight) -> None:
    flight.event("ready")
    flight.until("document.querySelector('#phase-button').innerText === 'Arm'")
    flight.until("document.querySelector('[data-check=plan].good') !== null")
    flight.until(is_lamp("heads", "good"))
    flight.until(is_lamp("position", "good"))
    flight.until("document.querySelectorAll('#map canvas[data-map]').length > 0")
    check(flight, "before-arming", "document.querySelector('#phase-button').innerText === 'Arm'")


def test_on_a_line(flight: Flight) -> None:
    flight.browser.click("#phase-button")
    flight.until("document.querySelector('#phase-button').innerText === 'Start line'")
    flight.browser.click("#phase-button")
    flight.event("phase", phase="flying")
    if flight.is_late():
        # The emulated aircraft turns onto the next line after its first exposure.
        flight.browser.click("[data-command=trigger]")
    flight.event("processed", number=1)
    check(flight, "on-a-line", ON_A_LINE)


def test_between_lines(flight: Flight) -> None:
    check(flight, "between-lines", BETWEEN_LINES)


def test_degraded(flight: Flight) -> None:
    """On a line a cable is pulled off a head, then off the receiver, and the disk fills."""
    flight.until(ON_A_LINE)
    flight.emulator.add_fault(f"cable-pulled@0:{LOST_HEAD},{LATER_S}")
    flight.event("device", device=LOST_HEAD, name="lost")
    flight.fill_disk()
    flight.service.wait_for(lambda e: e["event"] == "sealed" and e["missing"], WITHIN_S)
    flight.emulator.add_fault(f"cable-pulled@0:receiver,{LATER_S}")
    flight.event("device", device="gnss", name="lost")
    flight.event("disk")
    flight.until(DEGRADED)
    check(flight, "degraded", DEGRADED)


def test_link_lost_and_back(flight: Flight) -> None:
    pid = flight.page_process()
    os.kill(pid, signal.SIGSTOP)
    try:
        flight.until(LINK_LOST)
        check(flight, "link-lost", LINK_LOST)
    finally:
        os.kill(pid, signal.SIGCONT)
    flight.until(f"!({LINK_LOST})")
    flight.until(is_lamp("link", "good"))


def test_after_landing(flight: Flight) -> None:
    flight.browser.click("[data-command=land]")
    flight.until("document.querySelector('#ask-confirm').open")
    flight.browser.click("#confirm-do")
    flight.event("phase", phase="landed")
    flight.until(LANDED)
    flight.until("document.querySelectorAll('[data-file]').length === 4")
    flight.until("document.querySelector('[data-action=verify]') !== null")
    check(flight, "landed", LANDED, phone_tab="flight", seen=".next-steps")
    flight.service.process.terminate()
    ended = flight.event("ended")
    assert ended["failure"] is None and ended["ledger"]["balanced"]
    has_ended = "document.body.classList.contains('flight-ended')"
    flight.until(has_ended)
    check(flight, "after-landing", has_ended, phone_tab="flight", seen="#landing h2")
