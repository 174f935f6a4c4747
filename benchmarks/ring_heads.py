"""Emulated heads that send from a ring of three exposures made beforehand, mapped from disk.

Nothing is rendered: photon noise alone costs ten seconds per full exposure. Every frame begins with
its number, its place in the ring and a checksum, so that the storing process can be checked.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
import sys
import threading
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from processing.rig import find_rig
from sim_hw.devices.pulse_bus import Firing, PulseBus
from sim_hw.gige.gige_head import ExposureRequest, FrameSize, GigeHead, HeadIdentity, Pacing
from sim_hw.processes.parent_death import terminate_with_parent
from sim_hw.world.world_clock import FreeRunningClock

RING = 3
MARK = np.frombuffer(b"syntopic", "<u2")
NUMBER_AT, PLACE_AT, CHECKSUM_AT, HEADER_PX = 4, 6, 7, 16
READY_WITHIN_S = 300.0
POLL_S = 0.5


@dataclass(frozen=True)
class RingPlan:
    """What the heads of one process send, and where they answer."""

    rig: str
    ring: Path
    addresses: Mapping[str, str]
    rate_bytes_per_s: float
    burst_nbytes: int = 512 * 1024


def build_ring(rig_name: str, frames: Path | None, folder: Path) -> None:
    """Write the ring of every sensor to one folder: `SENSOR.raw`, three frames each.

    Args:
        rig_name: a shipped rig or a rig file.
        frames: Level-0 of one exposure, `SENSOR.tif`; None takes noise.
        folder: where they go; kept for the next run.
    """
    rig = find_rig(rig_name)
    folder.mkdir(parents=True, exist_ok=True)
    for index, sensor in enumerate(rig.sensors):
        path = folder / f"{sensor.name}.raw"
        shape = (sensor.height_px, sensor.width_px)
        if path.exists() and path.stat().st_size == RING * shape[0] * shape[1] * 2:
            continue
        if frames is None:
            source = np.random.default_rng(index).integers(0, 4096, shape, dtype=np.uint16)
        else:
            source = tifffile.imread(frames / f"{sensor.name}.tif")
            if source.shape != shape or source.dtype != np.uint16:
                raise ValueError(
                    f"{frames / sensor.name}.tif is {source.dtype} of {source.shape}; "
                    f"{rig.name} has uint16 of {shape}"
                )
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            for place in range(RING):
                frame = np.roll(source, 17 * place, axis=0)
                frame[0, :HEADER_PX] = 0
                frame[0, PLACE_AT] = place
                checksum = zlib.crc32(frame.reshape(-1)[HEADER_PX:].tobytes())
                frame[0, CHECKSUM_AT : CHECKSUM_AT + 2] = checksum & 0xFFFF, checksum >> 16
                frame[0, : len(MARK)] = MARK
                file.write(np.ascontiguousarray(frame, "<u2").data)
        part.rename(path)


def number_of(frame: NDArray[np.uint16]) -> int | None:
    """Exposure number in a frame's header, from 1; None where it is no frame of the ring."""
    head = frame.reshape(-1)[:HEADER_PX]
    if not np.array_equal(head[: len(MARK)], MARK):
        return None
    return int(head[NUMBER_AT]) | int(head[NUMBER_AT + 1]) << 16


def is_intact(frame: NDArray[np.uint16]) -> bool:
    """Whether all pixels behind the header are those that were made beforehand."""
    flat = frame.reshape(-1)
    received = int(flat[CHECKSUM_AT]) | int(flat[CHECKSUM_AT + 1]) << 16
    return zlib.crc32(flat[HEADER_PX:].tobytes()) == received


class RingSensor:
    """A sensor that shows the frames of its ring, one after another, with their number."""

    def __init__(self, path: Path, shape: tuple[int, int]) -> None:
        # Private pages: the number goes into the first one only, the others stay those on disk.
        self._frames = np.memmap(path, "<u2", "c", shape=(RING, *shape))
        self._frames.reshape(-1)[::2048].sum()  # in memory before anybody is waited for

    def expose(self, request: ExposureRequest) -> NDArray[np.uint16]:
        frame: NDArray[np.uint16] = self._frames[request.counter % RING]
        frame[0, NUMBER_AT : NUMBER_AT + 2] = request.counter & 0xFFFF, request.counter >> 16
        return frame


def serve(plan: RingPlan, pipe: Connection) -> None:
    """Body of a process of heads: until the pipe closes; sends its counts at the end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    terminate_with_parent()
    rig = find_rig(plan.rig)
    heads: dict[str, GigeHead] = {}
    for index, (name, address) in enumerate(plan.addresses.items()):
        sensor = rig.sensor(name)
        shown = RingSensor(plan.ring / f"{name}.raw", (sensor.height_px, sensor.width_px))
        heads[name] = GigeHead(
            HeadIdentity(address, sensor.serial or f"ring-{name}", "Ring", "Benchmark", name),
            FrameSize(sensor.width_px, sensor.height_px),
            shown.expose,
            lambda _mono_ns: 30.0,
            FreeRunningClock(offset_ns=index * 10**11, drift_ppm=float(index - 6)),
            packet_pacing=Pacing(plan.rate_bytes_per_s, plan.burst_nbytes),
        )
    for head in heads.values():
        head.start()
    pipe.send("ready")
    try:
        while True:
            if pipe.poll(POLL_S):
                received = pipe.recv()
                if received is None:
                    break
                count, starts_ns = received
                for name, head in heads.items():
                    if name in starts_ns:
                        head.line(starts_ns[name], count)
    except EOFError:
        return
    pipe.send({name: dict(head.statistics()) for name, head in heads.items()})
    for head in heads.values():
        head.close()


def main() -> None:
    """Body of the emulator: `python -m benchmarks.ring_heads`, a JSON object as argument.

    Prints all addresses, ends when its standard input closes, and then prints its counts.
    """
    request = json.loads(sys.argv[1])
    rig = find_rig(request["rig"])
    addresses = dict(request["addresses"])
    context = multiprocessing.get_context("spawn")
    pipes, workers = [], []
    names = list(addresses)
    for part in range(request["processes"]):
        chosen = names[part :: request["processes"]]
        plan = RingPlan(
            request["rig"],
            Path(request["ring"]),
            {name: addresses[name] for name in chosen},
            request["rate_bytes_per_s"],
        )
        parent_end, child_end = context.Pipe()
        worker = context.Process(target=serve, args=(plan, child_end), daemon=True)
        worker.start()
        child_end.close()
        pipes.append(parent_end)
        workers.append(worker)
    for pipe in pipes:
        if not pipe.poll(READY_WITHIN_S) or pipe.recv() != "ready":
            raise SystemExit("the heads did not come up; see above")
    sending = threading.Lock()

    def fire(firing: Firing) -> None:
        starts = _starts(rig.cones, firing)
        with sending:
            for pipe in pipes:
                pipe.send((firing.count, starts))

    bus_address = (request.get("bus_host", "127.0.0.1"), 0)
    bus = PulseBus(rig.name, [cone.name for cone in rig.cones], fire, bus_address)
    bus.start()
    host, port = bus.address
    ready = {"host": host, "port": port, "pids": [worker.pid for worker in workers]}
    print(json.dumps(ready), flush=True)
    sys.stdin.read()
    bus.close()
    counted: dict[str, Any] = {}
    for pipe in pipes:
        pipe.send(None)
        if pipe.poll(READY_WITHIN_S):
            counted |= pipe.recv()
    print(json.dumps(counted), flush=True)


def _starts(cones: Sequence[Any], firing: Firing) -> dict[str, int]:
    """Start of exposure of every sensor, ns."""
    pulses = firing.pulses_mono_ns
    return {s.name: pulses[c.name] for c in cones if c.name in pulses for s in c.sensors}


if __name__ == "__main__":
    main()
