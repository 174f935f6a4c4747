"""A flight of the emulated rig while others attack it from the network.

`python -m tests.system.attacked_flight OUT EXPOSURES`, in a network namespace of its own; prints
one JSON object. Blocks of exposures are attacked in turn with blocks in which the same load goes to
an unrelated port.
"""

from __future__ import annotations

import argparse
import hashlib
import http.client
import json
import math
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import tifffile

from daemon.cli.sim import Emulator, free_first_address, service_toml, simulator_arguments
from daemon.onboard.monitoring.access.tokens import add_token
from tests.support.stopwatch import Stopwatch
from tests.system.demo_mission import ROOT, syntopic
from tests.system.test_operators_page import Running

WITHIN_S = 180.0
MAVLINK_PORT = 14_600
KEY = bytes(range(32))
STOP_CAPTURE = 2001
SIGNING_EPOCH_UNIX_S = 1_420_070_400


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("exposures", type=int)
    parser.add_argument(
        "--block", type=int, default=4, help="exposures attacked, and not, in turn (default: 4)"
    )
    parser.add_argument("--scenes", type=Path)
    given = parser.parse_args()
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    subprocess.run(["ip", "link", "set", "lo", "multicast", "on"], check=False)
    subprocess.run(["ip", "route", "add", "224.0.0.0/4", "dev", "lo"], check=False)
    out: Path = given.out
    arguments = simulator_arguments("ultracam-x-mini", out / "sim", seed=4, dc=0, displace=[])
    # One exposure is sent again and again: no more ground is needed.
    arguments += ["--exposures", "4", "--still", "--digests"]
    if given.scenes is not None:
        arguments += ["--scene-cache", str(given.scenes)]
    emulator = Emulator([*arguments, "--first-address", free_first_address()])
    try:
        found = fly(out, emulator, given.exposures, given.block)
    finally:
        emulator.end()
    found["pixels"] = compared(Path(found["mission"]), out / "sim" / "sent")
    found["verified"] = syntopic("verify", found["mission"]).returncode
    print(json.dumps(found))


def fly(out: Path, emulator: Emulator, count: int, block: int) -> dict[str, Any]:
    (out / "key").write_text(KEY.hex())
    (out / "key").chmod(0o600)
    config = out / "service.toml"
    text = service_toml(
        emulator.ready, root="missions", count=count, end_when_done=True, watch_port=0
    ).replace("[trigger]\n", '[trigger]\nstart = "on command"\n')
    config.write_text(
        f'{text}\n[watch.mavlink]\nconnect = "udpin:127.0.0.1:{MAVLINK_PORT}"\n'
        'commands = "signed"\nsigning_key = "key"\n'
    )
    token = add_token(out / "tokens.toml", "operator", "operator")
    service = Running(config)
    attackers = None
    try:
        page = service.wait_for(lambda e: e["event"] == "watching", WITHIN_S)
        service.wait_for(lambda e: e["event"] == "ready", WITHIN_S)
        service.wait_for(lambda e: e["event"] == "kernels", WITHIN_S)
        recorded = recorded_command()
        aim = {
            "page": (page["host"], page["port"]),
            "mavlink": ("127.0.0.1", MAVLINK_PORT),
            "mavlink_frames": [frame.hex() for frame in recorded],
            "heads": [head["address"] for head in emulator.ready["heads"].values()],
            **ports_of(service.process.pid),
        }
        attackers = subprocess.Popen(
            [sys.executable, "-m", "tests.system.attackers"],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        aim_at(attackers, json.dumps(aim))
        command(page, token, "start")
        for number in range(1, count + 1):
            service.wait_for(
                lambda e, n=number: e["event"] == "triggered" and e["number"] == n, WITHIN_S
            )
            if (number - 1) % block == 0:
                at_camera = is_attacked(number, block)
                aim_at(attackers, "camera" if at_camera else "elsewhere")
        ended = service.wait_for(lambda e: e["event"] == "ended", WITHIN_S)
        output, _ = attackers.communicate(timeout=30)
        mission = service.wait_for(lambda e: e["event"] == "mission", 1)["path"]
    finally:
        if attackers is not None and attackers.poll() is None:
            attackers.kill()
        if service.process.poll() is None:
            service.process.terminate()
            service.process.wait(60)
    return {
        "mission": mission,
        "failure": ended["failure"],
        "ledger": ended["ledger"],
        "udp_sockets": len(aim["udp_ports"]) + len(aim["control_ports"]),
        "attackers": json.loads(output),
        "verdict_s": verdict_times(service.events, count, block),
        "reported": sorted({e["name"] for e in service.events if e["event"] == "device"}),
        "faults": [e["sentence"] for e in service.events if e["event"] == "device" and e["fault"]],
        "statuses": sorted({e["event"] for e in service.events}),
    }


def is_attacked(number: int, block: int) -> bool:
    return (number - 1) // block % 2 == 0


def aim_at(attackers: subprocess.Popen[str], line: str) -> None:
    assert attackers.stdin is not None
    attackers.stdin.write(line + "\n")
    attackers.stdin.flush()


def command(page: Mapping[str, Any], token: str, name: str) -> None:
    talking = http.client.HTTPConnection(page["host"], page["port"], timeout=20)
    talking.request(
        "POST", f"/api/v1/commands/{name}", body="{}",
        headers={"Authorization": f"Bearer {token}", "Content-Type": "application/json"},
    )  # fmt: skip
    answer = talking.getresponse()
    assert answer.status in (200, 202), (answer.status, answer.read())
    talking.close()


def recorded_command() -> list[bytes]:
    """An operator's signed command to stop, obeyed before the flight; and one of yesterday."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.settimeout(2)
        watch = Stopwatch()
        while True:
            # What is sent before the service listens is lost.
            frame = signed_stop(time.time())
            station.sendto(frame, ("127.0.0.1", MAVLINK_PORT))
            with suppress(TimeoutError):
                station.recv(1024)
                return [frame, signed_stop(time.time() - 86_400.0)]
            assert watch.is_within(WITHIN_S), "no answer to a signed command"


def signed_stop(unix_s: float) -> bytes:
    """A command to stop that an operator signed at a time."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    mav = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    mav.signing.secret_key = KEY
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = round((unix_s - SIGNING_EPOCH_UNIX_S) * 1e5)
    return bytes(mav.command_long_encode(1, 100, STOP_CAPTURE, *[0] * 8).pack(mav))


def ports_of(pid: int) -> dict[str, list[tuple[str, int]]]:
    """UDP sockets of the service and its children: streams, which are connected, and others."""
    inodes = set()
    for process in (pid, *children(pid)):
        for entry in Path(f"/proc/{process}/fd").iterdir():
            target = str(entry.readlink())
            if target.startswith("socket:["):
                inodes.add(target[8:-1])
    streams, others = set(), set()
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        if fields[9] not in inodes:
            continue
        place, is_connected = address(fields[1]), not fields[2].startswith("00000000")
        (streams if is_connected else others).add(place)
    # Next to each stream's socket lies the one that counts what others send.
    return {"udp_ports": sorted(streams), "control_ports": sorted(others - streams)}


def address(text: str) -> tuple[str, int]:
    number, _, port = text.partition(":")
    host = socket.inet_ntoa(struct.pack("=I", int(number, 16)))
    return ("127.0.0.1" if host == "0.0.0.0" else host), int(port, 16)


def children(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in listed]


def verdict_times(
    events: Sequence[Mapping[str, Any]], count: int, block: int
) -> dict[str, dict[str, float]]:
    """From trigger to verdict, s: median and 95th percentile, attacked and not.

    The first exposure of a block is not counted: the load changes during it.
    """
    at_ns = {
        (event["event"], event["number"]): int(event["mono_ns"])
        for event in events
        if event["event"] in ("triggered", "judged")
    }
    found = {}
    for kind, attacked in (("attacked", True), ("elsewhere", False)):
        times = sorted(
            (at_ns["judged", n] - at_ns["triggered", n]) * 1e-9
            for n in range(1, count + 1)
            if is_attacked(n, block) == attacked and (n - 1) % block
        )
        found[kind] = {
            "count": len(times),
            "median": round(statistics.median(times), 3),
            "p95": round(times[math.ceil(0.95 * len(times)) - 1], 3),
        }
    return found


def compared(mission: Path, sent: Path) -> dict[str, int]:
    """Every stored frame against what its head sent, by SHA-256 of the pixels."""
    found = {"stored": 0, "same": 0}
    digests = {
        path.stem: {json.loads(line)["sha256"] for line in path.read_text().splitlines()}
        for path in sent.glob("*.jsonl")
    }
    for path in sorted(mission.glob("L0/*/*.tif")):
        digest = hashlib.sha256(tifffile.imread(path)).hexdigest()
        found["stored"] += 1
        found["same"] += digest in digests[path.stem]
    return found


if __name__ == "__main__":
    main()
