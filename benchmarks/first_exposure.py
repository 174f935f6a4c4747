"""Seconds from `syntopic init` to the first stored exposure, for three arrangements of heads.

The heads are fake cameras of Aravis, the receiver is emulated at a pseudo-terminal, and software
triggers. All of them are in a network namespace of their own. Run: `python -m
benchmarks.first_exposure`.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

FAKE_CAMERA: Final = "arv-fake-gv-camera-0.8"
NAMESPACE: Final = ("unshare", "--map-root-user", "--net")
ARRANGEMENTS: Final = (("single", 1), ("side-by-side", 2), ("nadir-oblique", 3))
STEP_TIMEOUT_S: Final = 180.0
DEVICE_TIMEOUT_S: Final = 20.0
ROOT: Final = Path(__file__).parents[1]


@dataclass(frozen=True)
class FirstExposure:
    """One arrangement: seconds, and what the first exposure was."""

    arrangement: str
    heads: int
    init_s: float
    run_to_stored_s: float
    total_s: float
    check: str
    frames: int
    verdict: str
    flags: tuple[str, ...]


def missing() -> str | None:
    """What this computer needs for the measurement; None if nothing."""
    if shutil.which(FAKE_CAMERA) is None:
        return f"needs {FAKE_CAMERA} (Debian package aravis-tools)"
    if shutil.which("ip") is None:
        return "needs ip (Debian package iproute2)"
    try:
        tried = subprocess.run([*NAMESPACE, "true"], capture_output=True, timeout=10, check=False)
    except FileNotFoundError:
        return "needs unshare (Debian package util-linux)"
    return "no network namespaces here: unshare is refused" if tried.returncode else None


def measure(arrangement: str, heads: int) -> FirstExposure:
    """Measure one arrangement in a network namespace of its own."""
    done = subprocess.run(
        [*NAMESPACE, sys.executable, "-m", "benchmarks.first_exposure", arrangement, str(heads)],
        cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=3 * STEP_TIMEOUT_S, check=True,
    )  # fmt: skip
    found = json.loads(done.stdout.splitlines()[-1])
    return FirstExposure(**{**found, "flags": tuple(found["flags"])})


def _measure_here(arrangement: str, heads: int, folder: Path) -> FirstExposure:
    addresses = [f"127.0.0.{number}" for number in range(1, heads + 1)]
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    for address in addresses[1:]:
        subprocess.run(["ip", "address", "add", f"{address}/8", "dev", "lo"], check=True)
    with ExitStack() as devices:
        for address in addresses:
            command = [FAKE_CAMERA, "-i", address, "-s", f"FAKE-{address}"]
            devices.enter_context(_running(command, folder))
        receiver = ["-m", "sim_hw.processes.single_device", "nmea", "--no-strobe", "--at"]
        port = folder / "gnss"
        devices.enter_context(_running([sys.executable, *receiver, str(port)], folder))
        _wait_for(port)
        rig = folder / "rig"
        began = time.monotonic()
        options = ("--arrangement", arrangement, "--port", str(port), "--json")
        outcome = _json_of(
            ["init", str(rig), "--focal-length", "50", "--pixel-size", "5.5", *options], folder
        )
        init_s = time.monotonic() - began
        run_s = _seconds_to_stored(rig / "service.toml", folder)
    exposure = next(iter(sorted((rig / "missions").glob("*/L2/000001"))))
    report = json.loads((exposure / "quality.json").read_text("utf-8"))
    frames = list((rig / "missions").glob("*/L0/000001/*.tif"))
    return FirstExposure(
        arrangement,
        heads,
        round(init_s, 1),
        round(run_s, 1),
        round(init_s + run_s, 1),
        outcome["outcome"],
        len(frames),
        report["verdict"],
        tuple(report["flags"]),
    )


def _syntopic(arguments: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "daemon", *arguments]


def _json_of(arguments: Sequence[str], folder: Path) -> dict[str, Any]:
    done = subprocess.run(
        _syntopic(arguments), cwd=ROOT, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL,
        timeout=STEP_TIMEOUT_S, check=False,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"init ended with {done.returncode}: {done.stdout.decode()[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def _seconds_to_stored(config: Path, folder: Path) -> float:
    """From the start of the service to its first stored exposure; it ends after the verdict."""
    began = time.monotonic()
    stored_s = -1.0
    with subprocess.Popen(
        _syntopic(["run", str(config), "--json-lines"]),
        cwd=ROOT, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True,
    ) as service:  # fmt: skip
        assert service.stdout is not None
        limit = threading.Timer(STEP_TIMEOUT_S, service.kill)
        limit.start()
        try:
            for line in service.stdout:
                event = json.loads(line).get("event")
                if event == "stored" and stored_s < 0:
                    stored_s = time.monotonic() - began
                if event == "processed":
                    service.send_signal(signal.SIGINT)
                    break
            service.communicate(timeout=STEP_TIMEOUT_S)
        finally:
            limit.cancel()
            service.kill()
    if stored_s < 0:
        raise RuntimeError("no exposure was stored")
    return stored_s


@contextmanager
def _running(command: Sequence[str], folder: Path) -> Iterator[None]:
    with (folder / "devices.log").open("ab") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(DEVICE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(DEVICE_TIMEOUT_S)


def _wait_for(path: Path) -> None:
    deadline = time.monotonic() + DEVICE_TIMEOUT_S
    while not path.exists():
        if time.monotonic() > deadline:
            raise RuntimeError(f"{path} did not appear; the emulated receiver did not start")
        time.sleep(0.05)


def main(arguments: Sequence[str]) -> int:
    if arguments:
        name, count = arguments
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(asdict(_measure_here(name, int(count), Path(folder)))))
        return 0
    needed = missing()
    if needed is not None:
        print(needed, file=sys.stderr)
        return 1
    print(f"load {os.getloadavg()[0]:.1f}", file=sys.stderr)
    for arrangement, heads in ARRANGEMENTS:
        print(json.dumps(asdict(measure(arrangement, heads))), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
