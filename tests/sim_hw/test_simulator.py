"""An emulated rig as any program meets it: started as a process, met on the wire, held to truth."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import serial
from pymodbus.client import ModbusSerialClient
from pyubx2 import UBXReader

from sim_hw import SimulatorError
from sim_hw.gige import features as at
from sim_hw.processes.head_process import FirstLine
from sim_hw.processes.simulator import head_addresses
from sim_hw.world.electronics import Electronics, true_sensor
from sim_hw.world.rendering import ExposureParameters, light_on_sensor
from sim_hw.world.scene import open_scene
from sim_hw.world.truth import world_of
from sim_hw.world.world import World, WorldSettings
from tests.sim_hw.gige.test_gige_head import Controller
from tests.support.stopwatch import Stopwatch, slowdown

pytestmark = pytest.mark.realtime


READY_WITHIN_S = 90.0
ENDS_WITHIN_S = 60.0
WEEK_NS = 604_800_000_000_000
EPOCH = 1_400_000_000_000_000_000


class Emulator:
    """`python -m sim_hw` with a short line, at addresses of its own."""

    def __init__(self, out: Path, cache: Path, first_address: str, *options: str) -> None:
        self.errors = out.parent / f"{out.name}.log"
        with self.errors.open("w") as errors:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "sim_hw", "ultracam-x-mini", "--out", str(out)),
                    *("--scene-cache", str(cache), "--exposures", "1", "--seed", "5"),
                    *("--first-address", first_address, *options),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        assert self.process.stdout is not None
        watch = Stopwatch()
        line = self.process.stdout.readline()
        assert watch.is_within(READY_WITHIN_S)
        assert line, self.errors.read_text()
        self.ready: dict[str, Any] = json.loads(line)

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(ENDS_WITHIN_S * slowdown())


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scenes")


@pytest.fixture(scope="module")
def emulator(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Iterator[Emulator]:
    out = tmp_path_factory.mktemp("sim") / "out"
    emulator = Emulator(
        out, cache, "127.66.1.2", "--dc", "12", "--displace", "SU02=1.0,-0.6", "--read-faults"
    )
    yield emulator
    if emulator.process.poll() is None:
        emulator.end()


def fire(address: str, sequences: Sequence[int], delays_ns: dict[str, int]) -> list[str]:
    host, port = address.split(":")
    with socket.create_connection((host, int(port)), timeout=5) as connection:
        lines = connection.makefile("rw", newline="\n")
        answers = [lines.readline()]
        commands = [f"DELAY {cone} {delay}" for cone, delay in delays_ns.items()]
        for command in [*commands, *(f"FIRE {n}" for n in sequences)]:
            lines.write(command + "\n")
            lines.flush()
            answers.append(lines.readline())
            if command.startswith("FIRE"):
                # As on a real head, a pulse during an exposure is not taken.
                time.sleep(0.3)
    return [answer.strip() for answer in answers]


def wait_for(condition: Any, what: str, within_s: float = 10.0) -> None:
    watch = Stopwatch()
    while not condition():
        assert watch.is_within(within_s), f"waited {within_s} s for {what}"
        time.sleep(0.05)


def test_it_states_once_where_everything_is(emulator: Emulator) -> None:
    ready = emulator.ready
    assert ready["event"] == "ready"
    assert list(ready["heads"]) == [
        *("SU00", "SU01", "SU02", "SU03", "SU10", "SU11", "SU20", "SU21", "SU30"),
        *("R", "G", "B", "N"),
    ]
    assert ready["heads"]["SU00"] == {"address": "127.66.1.2", "serial": "M-SU00"}
    assert len({head["address"] for head in ready["heads"].values()}) == 13
    assert ready["probes"]["channels"] == ["0", "1", "2", "3", "R", "G", "B", "N"]
    plan = ready["plan"]
    assert plan["gsd_m"] == pytest.approx(0.2149, abs=1e-4)
    assert plan["distance_m"] == pytest.approx(0.4 * 2226 * plan["gsd_m"], abs=0.01)
    assert plan["tdi_shifts"]["0"] == 1
    assert plan["exposure_time_us"]["0"] == pytest.approx(plan["gsd_m"] / 55 * 1e6, rel=1e-3)
    assert (Path(ready["calibration"]) / "rig.toml").read_text() == Path(
        ready["rig_file"]
    ).read_text()
    assert len(list((Path(ready["calibration"]) / "radiometry").glob("*.npz"))) == 13


def test_probes_read_the_temperatures_of_their_cones(emulator: Emulator) -> None:
    probes = emulator.ready["probes"]
    client = ModbusSerialClient(probes["port"], baudrate=probes["baudrate"], timeout=2)
    assert client.connect()
    try:
        answer = client.read_input_registers(
            probes["first_register"], count=8, device_id=probes["unit"]
        )
    finally:
        client.close()
    assert np.array(answer.registers) / 10 == pytest.approx(32.0, abs=1.3)


def test_frames_marks_and_truth_of_a_pulse_belong_together(emulator: Emulator) -> None:
    ready = emulator.ready
    truth_folder = Path(ready["truth"])
    port = serial.Serial(ready["receiver"]["port"], timeout=0.5)
    names = ("SU00", "SU10")
    hosts = {
        name: Controller(SimpleNamespace(address=ready["heads"][name]["address"])) for name in names
    }
    try:
        for host in hosts.values():
            host.write(at.CONTROL_PRIVILEGE, at.CONTROL_ACCESS)
            host.write_double("ExposureTime", ready["plan"]["exposure_time_us"]["0"])
            host.stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_000_000)
            host.open()
        # Cone 1 is 80 mm ahead of cone 0: at 55 m/s it fires 1.4545 ms before it.
        with ThreadPoolExecutor() as listening:
            coming = {name: listening.submit(two_frames, host) for name, host in hosts.items()}
            answers = fire(ready["pulse_bus"], [7, 8], {"0": 1_454_545, "1": 0})
            frames = {name: future.result(20) for name, future in coming.items()}
        assert [a.split()[0] for a in answers] == ["PULSEBUS", "OK", "OK", "FIRED", "FIRED"]
        wait_for(lambda: len(list(truth_folder.glob("[0-9]*.npz"))) == 2, "two files of truth")
        stamps = marks(port, count=2)
    finally:
        for host in hosts.values():
            host.close()
        port.close()
    world = world_of(truth_folder)
    scene = open_scene(world.scene_settings, Path(emulator_cache(emulator)))
    truths = [dict(np.load(path)) for path in sorted(truth_folder.glob("[0-9]*.npz"))]
    assert stamps == pytest.approx([int(t["mark_gps_ns"]) for t in truths], abs=200)
    for number, truth in enumerate(truths):
        assert truth["SU00.mid_gps_ns"] - truth["SU10.mid_gps_ns"] == 1_454_545
        flight = world.flight.beginning_first_line_at(float(truth["first_line_at_m"]))
        for name in names:
            cone, sensor = world.rig.cone_of(name), world.rig.sensor(name)
            look = ExposureParameters(
                int(truth[f"{name}.mid_gps_ns"]),
                float(truth[f"{name}.exposure_time_us"]),
                int(truth[f"{name}.tdi_shifts"]),
            )
            light = light_on_sensor(world, scene, flight, cone, sensor, look)
            field = world.field_radius_mm(cone)
            electronics = Electronics(
                sensor,
                true_sensor(cone, sensor, 5, field_radius_mm=field),
                world.electrons_per_radiance_s(cone),
            )
            again = electronics.frame(
                light,
                exposure_time_us=look.exposure_time_us,
                tdi_shifts=look.tdi_shifts,
                gain_db=0.0,
                temperature_c=32.0,
                random=np.random.default_rng(number),
            ).astype(float)
            wire = np.frombuffer(frames[name][number], "<u2", 832 * 1248).reshape(832, 1248)
            # Two frames of one light differ by their noise and by nothing else.
            sigma = np.sqrt(2 * (np.maximum(again - 64, 0) / 20 + 2.25 + 1 / 12))
            difference = (wire - again) / sigma
            assert abs(np.median(difference)) < 0.02
            assert difference.std() == pytest.approx(1.0, abs=0.04)


def two_frames(host: Controller) -> list[bytes]:
    return [host.receive_frame().payload for _ in range(2)]


def emulator_cache(emulator: Emulator) -> str:
    arguments = list(map(str, emulator.process.args))
    return arguments[arguments.index("--scene-cache") + 1]


def marks(port: serial.Serial, *, count: int) -> list[int]:
    """Rising edges reported by the receiver, GPS ns."""
    found: list[int] = []
    reader = UBXReader(port, protfilter=2)
    watch = Stopwatch()
    while len(found) < count:
        assert watch.is_within(10.0), f"waited 10 s for {count} event marks, got {found}"
        _, message = reader.read()
        if message is not None and message.identity == "TIM-TM2" and message.newRisingEdge:
            edge_ns = message.wnR * WEEK_NS + message.towMsR * 1_000_000 + message.towSubMsR
            found.append(edge_ns)
    return found


def test_faults_are_planned_while_it_runs(emulator: Emulator) -> None:
    port = Path(emulator.ready["receiver"]["port"])
    host = Controller(SimpleNamespace(address=emulator.ready["heads"]["SU30"]["address"]))
    neighbour = Controller(SimpleNamespace(address=emulator.ready["heads"]["SU20"]["address"]))
    stdin = emulator.process.stdin
    assert stdin is not None
    try:
        assert port.exists() and answers(host)
        stdin.write("cable-pulled@0:SU99,1\n")
        stdin.write("cable-pulled@0:receiver,1\n")
        stdin.write("cable-pulled@0:SU30,3\n")
        stdin.flush()
        wait_for(lambda: not port.exists(), "the port of the receiver to go")
        wait_for(lambda: not answers(host), "the head to be silent")
        assert answers(neighbour), "the fault is of one head"
        wait_for(port.exists, "the port of the receiver to come back")
        wait_for(lambda: answers(host), "the head to come back")
    finally:
        host.close()
        neighbour.close()
    assert "there is no device 'SU99'" in emulator.errors.read_text()


def answers(host: Controller) -> bool:
    host.control.settimeout(0.3)
    try:
        host.ask(0x80, struct.pack(">I", at.CONTROL_PRIVILEGE))
    except TimeoutError:
        return False
    return True


def test_it_ends_with_everything_on_request(emulator: Emulator) -> None:
    assert emulator.end() == 0
    assert emulator.process.stdout is not None
    assert emulator.process.stdout.read() == ""
    for head in emulator.ready["heads"].values():
        assert is_free(head["address"])


def is_free(address: str) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, 3956))
        except OSError:
            return False
        return True


def test_killed_it_leaves_no_process_behind(tmp_path: Path, cache: Path) -> None:
    emulator = Emulator(tmp_path / "out", cache, "127.66.2.2", "--processes", "1")
    os.kill(emulator.process.pid, signal.SIGKILL)
    emulator.process.wait(ENDS_WITHIN_S * slowdown())
    addresses = [head["address"] for head in emulator.ready["heads"].values()]
    wait_for(lambda: all(map(is_free, addresses)), "the heads to go away", ENDS_WITHIN_S)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["no-such-rig"], "neither a file nor one of: "),
        (["ultracam-x-mini", "--displace", "SU99=1,1"], "displaced sensor 'SU99'"),
        (["ultracam-x-mini", "--displace", "SU02"], "write it as SU02=1.0,-0.6"),
        (["ultracam-x-mini", "--first-address", "10.0.0.1"], "not a loopback address"),
    ],
)
def test_what_cannot_be_flown_is_refused_in_a_sentence(
    tmp_path: Path, arguments: list[str], sentence: str
) -> None:
    refused = subprocess.run(
        [sys.executable, "-m", "sim_hw", *arguments, "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert refused.returncode != 0
    assert sentence in refused.stderr
    assert "Traceback" not in refused.stderr
    assert refused.stdout == ""


def test_heads_count_up_from_the_first_address(tmp_path: Path) -> None:
    from processing.rig import shipped_rigs

    rig_file = str(shipped_rigs()["ultracam-x-mini"])
    world = World(WorldSettings(rig_file=rig_file, seed=1, epoch_gps_ns=EPOCH))
    addresses = head_addresses(world, "127.0.1.250")
    assert addresses["SU00"] == "127.0.1.250"
    assert addresses["SU30"] == "127.0.2.2"
    with pytest.raises(SimulatorError, match="loopback"):
        head_addresses(world, "192.168.1.1")


def test_before_the_first_exposure_it_flies_straight_on_however_long_that_takes() -> None:
    from processing.rig import shipped_rigs

    rig_file = str(shipped_rigs()["ultracam-x-mini"])
    world = World(WorldSettings(rig_file=rig_file, seed=1, epoch_gps_ns=EPOCH, exposures=2))
    line = FirstLine(world.flight, get_context("spawn").Value("d", math.nan))
    late = EPOCH + 1_000_000_000_000
    before = line.flight.pose(late)
    assert before.position_enu_m[1] == pytest.approx(55_000, abs=10)
    line.begin(late)
    begun = line.flight.pose(late)
    assert begun.position_enu_m == pytest.approx(before.position_enu_m, abs=1e-6)
    assert begun.enu_from_body == pytest.approx(before.enu_from_body, abs=1e-12)
    # Two exposures long, the line ends after 383 m: 7 s later the turn has begun.
    turning = line.flight.pose(late + 15_000_000_000)
    assert abs(turning.roll_rad) > math.radians(10)
