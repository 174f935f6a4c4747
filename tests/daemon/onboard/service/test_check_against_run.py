"""`syntopic check` and `syntopic run` agree about every planted fault, both ways.

refused: the configuration is refused, by both with the same sentences and status 2.
prevented: `check` fails, and `run` ends with the same sentence and status 1 before it flies.
degraded: `check` fails, and `run` flies and names the same fault with the same sentence.
waiting: `check` waits, and `run` names the same as missing for arming.
passes: `check` passes, and `run` makes an exposure without any fault.
"""

# ruff: noqa: E501 - one fault a line reads as a table

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import serial

from daemon.mission.layout import CURRENT_FILE
from daemon.onboard.preflight import prerequisites, system_check
from daemon.onboard.preflight.service_file import load
from daemon.onboard.service.startup import create_mission
from daemon.products.processor import Processor
from drivers.base.extras import missing
from tests.daemon.onboard.service.flight_parts import Planted, Reported, check, in_threads, run

pytestmark = pytest.mark.trust

NMEA_VOID = b"$GNRMC,101500.00,V,,,,,,,211126,,,N*60\r\n$GNGGA,,,,,,0,00,99.99,,,,,,*56\r\n"
NAVIGATOR = '[[navigator]]\nname = "gnss"\ndriver = "{}"\nport = "{}"\nsilence_s = 0.6\n'
PROBES = '[[thermometer]]\nname = "probes"\ndriver = "modbus-rtu"\nchannels = ["A"]\nparity = "N"\n'
WATCH = "[watch]\nport = 0\nannounce = false\n"
AFTER = 'loop = true\n\n[[head]]\nsensor = "SUB"'


CONSEQUENCES = ("the disk is ", "not balanced: ")
"""Sentences of the flight about what follows from a fault."""


class Fault(NamedTuple):
    """What is planted, what both commands make of it, and words of the sentence."""

    name: str
    outcome: str
    words: str
    plant: Callable[[Planted], object]


def changed(old: str, new: str) -> Callable[[Planted], object]:
    return lambda planted: planted.change(old, new)


def added(text: str) -> Callable[[Planted], object]:
    return lambda planted: planted.add(text)


def file(name: str, content: bytes, text: str, mode: int = 0o600) -> Callable[[Planted], object]:
    def plant(planted: Planted) -> None:
        path = planted.folder / name
        path.write_bytes(content)
        path.chmod(mode)
        planted.add(text)

    return plant


def replaced(place: object, name: str, value: object) -> Callable[[Planted], object]:
    return lambda planted: planted.monkeypatch.setattr(place, name, value)


def many(*plants: Callable[[Planted], object]) -> Callable[[Planted], object]:
    return lambda planted: [plant(planted) for plant in plants]


def interrupted(*after: Callable[[Planted], object]) -> Callable[[Planted], object]:
    """A mission that was being flown, and what was changed since."""

    def plant(planted: Planted) -> None:
        planted.write()
        create_mission(*load(planted.config), planted.config)
        for change in after:
            change(planted)

    return plant


def damaged_copy(planted: Planted) -> None:
    (copy,) = (planted.folder / "missions").glob("*/rig.toml")
    copy.chmod(0o600)
    copy.write_text("format = 1\n")


def port_in_use(planted: Planted) -> None:
    taken = socket.create_server(("127.0.0.1", 0))
    planted.closing.append(taken.close)
    planted.add(WATCH.replace("port = 0", f"port = {taken.getsockname()[1]}"))


def occupied_port(planted: Planted) -> None:
    port = planted.line(lambda _: b"")
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    planted.closing.append(lambda: os.close(descriptor))
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    planted.add(NAVIGATOR.format("nmea", port))


def no_permission(planted: Planted) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(13, "could not open port: Permission denied")

    planted.monkeypatch.setattr(serial, "Serial", refuse)
    planted.add(NAVIGATOR.format("nmea", "/dev/null"))


def spoken(driver: str, data: Callable[[int], bytes]) -> Callable[[Planted], object]:
    """A receiver's line with other data."""
    return lambda planted: planted.add(NAVIGATOR.format(driver, planted.line(data)))


def other_server(planted: Planted) -> None:
    """A port where somebody listens who is no pulse bus."""
    server = socket.create_server(("127.0.0.1", 0))
    planted.closing.append(server.close)
    planted.by_line(server.getsockname()[1])


def no_library(planted: Planted) -> None:
    def refuse(name: str) -> None:
        raise missing(name, "planted")

    planted.monkeypatch.setattr(prerequisites, "require", refuse)
    planted.add(WATCH)


def no_write(*_: object) -> float:
    raise OSError(5, "Input/output error")


def two_pan_heads(planted: Planted) -> None:
    for band in ("red", "nir"):
        planted.change(f'role = "colour"\nbands = ["{band}"]', 'role = "pan"\nbands = ["pan"]')


def radiometry(*files: str) -> Callable[[Planted], object]:
    def plant(planted: Planted) -> None:
        folder = planted.folder / "radiometry"
        folder.mkdir()
        for name in files:
            (folder / name).write_text("{}")
        planted.change('rig = "rig.toml"', 'rig = "rig.toml"\nradiometry = "radiometry"')

    return plant


def slow_kernels(planted: Planted) -> None:
    import threading

    event = threading.Event()
    planted.closing.append(event.set)
    planted.monkeypatch.setattr(Processor, "warm_up", lambda _: event.wait(60))
    planted.monkeypatch.setattr(system_check, "KERNELS_TIMEOUT_S", 0.3)


FAULTS = (
    # The configuration
    Fault("no TOML", "refused", "not valid TOML", changed("[mission]", "[mission")),
    Fault("unknown key", "refused", "mission.simulatd", changed("simulated", "simulatd")),
    Fault("text for a number", "refused", "trigger.count", changed("count = 3", 'count = "two"')),
    Fault("negative interval", "refused", "interval_s", changed("_s = 0.2\ncount", "_s = -1\ncount")),
    Fault("unknown rig", "refused", "neither a file", changed('"rig.toml"', '"ultracam-y"')),
    Fault("no rig file", "refused", "mission.rig", changed('"rig.toml"', '"absent.toml"')),
    Fault("rig with NaN", "refused", "f_mm", changed("f_mm = 100.0", "f_mm = nan")),
    Fault("rig with a negative pitch", "refused", "pitch_um", changed("h_um = 7.2", "h_um = -7.2")),
    Fault("rig of another format", "refused", "format", changed("format = 1", "format = 9")),
    Fault("unknown sensor", "refused", "head[1].sensor", changed('"SUB"\ndriver', '"X"\ndriver')),
    Fault("sensor twice", "refused", "second time", changed('"SUB"\ndriver', '"SUA"\ndriver')),
    Fault("unknown driver", "refused", "head[0].driver", changed('"folder"', '"foldr"')),
    Fault("unknown setting", "refused", "head[0].lop", changed("loop =", "lop =")),
    Fault("setting of wrong type", "refused", "head[0].loop", changed("loop = true", "loop = 1")),
    Fault("no head", "refused", "head", lambda p: setattr(p, "service", p.service.split("[[he")[0])),
    Fault("heads wait for a line", "refused", "trigger_source", changed("p = true", 'p = true\ntrigger_source = "line"')),
    Fault("heads wait for software", "refused", "trigger_source", changed('"software"', '"pulse-bus"\nport = 9')),
    Fault("heads without actions", "refused", "gige-action", changed('"software"', '"gige-action"')),
    Fault("one name for two devices", "refused", "name of its own", added(PROBES.replace("probes", "gnss") + 'port = "/dev/a"\n' + NAVIGATOR.format("nmea", "/dev/b"))),
    Fault("one port for two devices", "refused", "as is thermometer[0].port", added(PROBES + 'port = "/dev/a"\n' + NAVIGATOR.format("nmea", "/dev/a"))),
    Fault("distance without a distance", "refused", "distance_m", changed("count = 3", 'mode = "distance"')),
    Fault("plan mode without a plan", "refused", "plan.file", changed("count = 3", 'mode = "plan"')),
    Fault("plan missing", "refused", "plan.file", added('[plan]\nfile = "plan.kml"')),
    Fault("plan damaged", "refused", "plan.kml", file("plan.kml", b"<kml", '[plan]\nfile = "plan.kml"')),
    Fault("height model missing", "refused", "no such file", added('[plan]\nelevation = "d.tif"\nelevation_crs = "EPSG:25833"')),
    Fault("height model without a system", "refused", "elevation_crs", file("d.tif", b"", '[plan]\nelevation = "d.tif"')),
    Fault("calibration folder missing", "refused", "radiometry", changed('rig = "rig.toml"', 'rig = "rig.toml"\nradiometry = "gone"')),
    Fault("port out of range", "refused", "watch.port", added("[watch]\nport = 70000")),
    Fault("certificate without key", "refused", "belong together", added('[watch]\ntls_certificate = "c.pem"')),
    Fault("tokens in the clear", "refused", "without encryption", added('[watch]\nhost = "0.0.0.0"\ntokens = "t.toml"')),
    Fault("address without a port", "refused", "HOST:PORT", added('[watch]\nudp = ["10.0.0.1"]')),
    Fault("signed without a key", "refused", "signing_key", added('[watch.mavlink]\ncommands = "signed"')),
    Fault("unknown threshold", "refused", "no such threshold", changed("threads = 1", "threads = 1\nthresholds = { sharpnes = 0.3 }")),
    Fault("lens that is none of the rig's", "refused", "serials.lens", added('[serials]\nlens = { Z = "L-1" }')),
    Fault("baud rate as a text", "refused", "baudrate", added(NAVIGATOR.format("nmea", "/dev/a") + 'baudrate = "fast"')),
    # What prevents a flight
    Fault("calibration damaged", "prevented", "SUA.json", radiometry("SUA.json", "SUB.json")),
    Fault("mission root is a file", "prevented", "mission.root", file("missions", b"", "")),
    Fault("mission root cannot be written", "prevented", "mission.root", changed('"missions"', '"/proc/missions"')),
    Fault("too little memory", "prevented", "GB of memory", replaced(prerequisites, "available_memory_nbytes", lambda: 1000)),
    Fault("library missing", "prevented", "pip install 'syntopic[watch]'", no_library),
    Fault("mission marker damaged", "prevented", CURRENT_FILE, lambda p: ((p.folder / "missions").mkdir(), (p.folder / "missions" / CURRENT_FILE).write_text('{"mission": "../x"}'))),
    Fault("another head", "prevented", "serial number SN-9", lambda p: p.frames("A", head_serial="SN-9")),
    Fault("heads swapped", "prevented", "serial number SN-B", lambda p: (p.frames("A", head_serial="SN-B"), p.frames("B", head_serial="SN-A"))),
    Fault("frames of another size", "prevented", "32 x 24 px", lambda p: p.frames("B", shape=(24, 32))),
    Fault("frames of too few bits", "prevented", "12 bits", lambda p: p.frames("A", pixel_format="Mono8")),
    Fault("trigger unit without an output", "prevented", "none for cone B", lambda p: p.trigger_unit("A")),
    Fault("interrupted, its rig damaged", "prevented", "--new-mission", interrupted(damaged_copy)),
    Fault("interrupted, with other heads", "prevented", "has no sensor SUC", interrupted(changed('name = "SUB"', 'name = "SUC"'), changed('sensor = "SUB"', 'sensor = "SUC"'))),
    # What a flight goes on without
    Fault("disk too slow", "degraded", "too slow", replaced(prerequisites, "measure_write_s", lambda *_: 1e6)),
    Fault("disk refuses to write", "degraded", "check the disk", replaced(prerequisites, "measure_write_s", no_write)),
    Fault("disk full", "degraded", "space for 0 of 3", changed("disk_reserve_bytes = 0", f"disk_reserve_bytes = {1 << 60}")),
    Fault("calibration expired", "degraded", "was valid", changed('date = "2026-11-01"', 'date = "2001-01-01"')),
    Fault("calibration of no head", "degraded", "SUA, SUB", radiometry()),
    Fault("head absent", "degraded", "no folder", changed(f'"frames"\n{AFTER}', f'"/nowhere"\n{AFTER}')),
    Fault("head without frames", "degraded", "fits", lambda p: (p.folder / "frames/000001/SUB.tif").unlink()),
    Fault("head without a serial number", "degraded", "no serial number", lambda p: p.frames("A", head_serial="")),
    Fault("lens of another serial number", "degraded", "is stated to be", many(changed('name = "A"\nrole', 'name = "A"\nrole'), added('[serials]\nlens = { A = "L-2" }'), lambda p: setattr(p, "rig", p.rig.replace("f_mm = 100.0", 'f_mm = 100.0\nserial = "L-1"', 1)))),
    Fault("trigger unit absent", "degraded", "no trigger unit", lambda p: p.by_line(9)),
    Fault("no pulse bus at that port", "degraded", "its greeting", other_server),
    Fault("serial port missing", "degraded", "no such port", added(NAVIGATOR.format("ublox", "/dev/absent"))),
    Fault("receiver silent", "degraded", "nothing came", spoken("novatel", lambda _: b"")),
    Fault("wrong baud rate", "degraded", "speed is", spoken("septentrio", lambda n: bytes(range(n % 200, n % 200 + 50)))),
    Fault("receiver of another kind", "degraded", "is no", spoken("novatel", lambda _: NMEA_VOID)),
    Fault("port held by another", "degraded", "h", occupied_port),
    Fault("no permission on the port", "degraded", "permission denied", no_permission),
    Fault("thermometer absent", "degraded", "no such port", many(Planted.probes, added(PROBES + 'port = "/dev/absent"'))),
    Fault("thermometer silent", "degraded", "probes", many(Planted.probes, lambda p: p.add(PROBES + f'port = "{p.line(lambda _: b"")}"'))),
    Fault("thermometer of another number", "degraded", "probes", lambda p: p.thermometer(20.0, 21.0, settings="unit = 7")),
    Fault("open probe", "degraded", "no temperature of probe B", lambda p: p.thermometer(20.0, None)),
    Fault("probe without a channel", "degraded", "no temperature of probe B", lambda p: p.thermometer(20.0)),
    Fault("pulse per second absent", "degraded", "/dev/pps77", added('[[pps]]\nname = "pps"\ndriver = "kernel"\ndevice = "/dev/pps77"')),
    Fault("port of the page in use", "degraded", "in use", port_in_use),
    Fault("tokens open to everybody", "degraded", "chmod 640", file("t.toml", b"", WATCH + 'tokens = "t.toml"', 0o604)),
    Fault("tokens damaged", "degraded", "t.toml", file("t.toml", b"[", WATCH + 'tokens = "t.toml"')),
    Fault("certificate damaged", "degraded", "cannot be loaded", many(file("c.pem", b"no", ""), added(WATCH + 'tls_certificate = "c.pem"\ntls_key = "c.pem"'))),
    Fault("no such group", "degraded", "no group", added(WATCH + 'control = "c.sock"\ncontrol_group = "nobody-has-it"')),
    Fault("control is no socket", "degraded", "not a socket", file("c.sock", b"", WATCH + 'control = "c.sock"')),
    Fault("signing key open to everybody", "degraded", "chmod 600", file("k", b"00" * 32, WATCH + '[watch.mavlink]\nconnect = "udpout:127.0.0.1:9"\nsigning_key = "k"', 0o604)),
    Fault("signing key damaged", "degraded", "hexadecimal", file("k", b"abc", WATCH + '[watch.mavlink]\nconnect = "udpout:127.0.0.1:9"\nsigning_key = "k"')),
    Fault("interrupted, the rig changed", "degraded", "f_mm (100.0 in the mission, 101.5 now)", interrupted(changed("f_mm = 100.0", "f_mm = 101.5"))),
    # What comes by itself
    Fault("receiver that searches", "waiting", "no position", spoken("nmea", lambda _: NMEA_VOID)),
    Fault("kernels not loaded yet", "waiting", "kernels", slow_kernels),
    # Nothing wrong
    Fault("nothing", "passes", "", lambda _: None),
    Fault("two PAN heads side by side", "passes", "", two_pan_heads),
    Fault("mission root not there yet", "passes", "", changed('"missions"', '"some/where/missions"')),
    Fault("no tokens yet", "passes", "", added(WATCH + 'tokens = "t.toml"')),
    Fault("interrupted, nothing changed", "passes", "", interrupted()),
    Fault("a trigger unit", "passes", "", lambda p: p.trigger_unit("A", "B")),
    Fault("a receiver and a thermometer", "passes", "", lambda p: (p.receiver(), p.thermometer(20.0, 21.0))),
)  # fmt: skip


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    in_threads(made)
    made.frames("A")
    made.frames("B")
    yield made
    for close in reversed(made.closing):
        close()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.name}: {fault.outcome}")
def test_check_and_run_agree(planted: Planted, fault: Fault) -> None:
    if fault.outcome == "prevented":  # no exposure is begun while devices still answer
        planted.change("count = 3", 'count = 3\nstart = "on command"')
    fault.plant(planted)
    planted.write()
    if fault.outcome == "passes":
        planted.monkeypatch.setattr(system_check, "DATA_TIMEOUT_S", 30.0)
    checked = check(planted)
    sentences = checked.waiting if fault.outcome == "waiting" else checked.failing
    assert any(fault.words in sentence for sentence in sentences) == bool(sentences), checked
    assert checked.status == {"refused": 2, "waiting": 3, "passes": 0}.get(fault.outcome, 1)
    flown = run(planted, lambda output: AGREED[fault.outcome](checked, output))
    assert AGREED[fault.outcome](checked, flown), (checked, flown)
    assert flown.devices - {"service"} <= checked.devices, (checked, flown)
    output = {one for one in flown.failing if not one.startswith(CONSEQUENCES)}
    if flown.devices <= {"service"}:
        assert _is_named(frozenset(output), by=checked.failing), (checked, flown)


def test_there_are_at_least_sixty_faults() -> None:
    assert sum(fault.outcome != "passes" for fault in FAULTS) >= 60
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


def _is_named(sentences: frozenset[str], *, by: frozenset[str]) -> bool:
    """Whether each sentence is among the others, or within one of them, or around it."""
    named = [other for other in by if other]
    return all(one and any(one in other or other in one for other in named) for one in sentences)


AGREED: dict[str, Callable[[Reported, Reported], bool]] = {
    "refused": lambda checked, flown: flown == checked,
    "prevented": lambda checked, flown: (
        flown.status == 1 and bool(flown.failing) and not flown.has_flown
    ),
    "degraded": lambda checked, flown: (
        flown.status == 0 and _is_named(checked.failing, by=flown.failing | flown.waiting)
    ),
    "waiting": lambda checked, flown: any(
        sentence in reported for sentence in checked.waiting for reported in flown.waiting
    ),
    "passes": lambda checked, flown: flown.has_flown and not flown.failing,
}
"""Whether `run` and `check` report the same."""
