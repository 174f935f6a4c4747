"""A real PTP master on one of two hosts joined by a veth pair: ptp4l of linuxptp.

It stamps in software, never touches this computer's clock (`free_running`), and serves
CLOCK_REALTIME. So its clock is UTC: announced as TAI, it is the mistake of 37 s.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.namespaces import Host

TIMEOUT_S = 20.0


class PtpMaster:
    """A running ptp4l; `grandmaster` is its identity as it prints it."""

    def __init__(self, process: subprocess.Popen[bytes], place: Path) -> None:
        self.process, self._place = process, place

    def ask(self, command: str) -> str:
        """Send a management message with pmc, linuxptp's own client; its answer."""
        return subprocess.run(
            ["pmc", "-u", "-b", "0", "-s", str(self._place / "ptp4l"), command],
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=True,
        ).stdout

    @property
    def grandmaster(self) -> str:
        """The identity of its clock, 16 hexadecimal digits."""
        line = next(x for x in self.ask("GET DEFAULT_DATA_SET").splitlines() if "Identity" in x)
        return line.split()[-1].replace(".", "")

    def announce_tai(self) -> None:
        """Announce the timescale PTP with a UTC offset of 37 s, whatever the clock shows."""
        self.ask(
            "SET GRANDMASTER_SETTINGS_NP clockClass 6 clockAccuracy 0x20 "
            "offsetScaledLogVariance 0x4e5d currentUtcOffset 37 leap61 0 leap59 0 "
            "currentUtcOffsetValid 1 ptpTimescale 1 timeTraceable 1 frequencyTraceable 1 "
            "timeSource 0x20"
        )


@contextlib.contextmanager
def ptp_master(host: Host, place: Path, *, identity: str = "") -> Iterator[PtpMaster]:
    """Run ptp4l as a master on a host; a skip where linuxptp is not installed.

    Args:
        host: of `tests.support.namespaces.two_hosts`, the first.
        place: an empty folder.
        identity: of its clock, as ptp4l writes it; empty takes that of its interface.
    """
    program = shutil.which("ptp4l", path="/usr/sbin:/usr/bin")
    if program is None or shutil.which("pmc", path="/usr/sbin:/usr/bin") is None:
        pytest.skip("needs ptp4l (Debian package linuxptp)")
    place.mkdir(parents=True, exist_ok=True)
    settings: dict[str, object] = {
        "masterOnly": 1,
        "free_running": 1,
        "priority1": 100,
        "logSyncInterval": -3,
        "logAnnounceInterval": 0,
        "logMinDelayReqInterval": -3,
        "uds_address": place / "ptp4l",
    }
    if identity:
        settings["clockIdentity"] = identity
    interface = "sa" + host.name.rpartition("-")[2]
    options = [f"--{name}={value}" for name, value in settings.items()]

    def begin() -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [program, "-S", "-4", "-E", "-i", interface, "-m", *options],
            stdout=(place / "log").open("wb"),
            stderr=subprocess.STDOUT,
        )

    process = host.run(begin)
    try:
        deadline = time.monotonic() + TIMEOUT_S
        while "assuming the grand master role" not in (place / "log").read_text():
            assert process.poll() is None, (place / "log").read_text()
            assert time.monotonic() < deadline, (place / "log").read_text()
            time.sleep(0.1)
        yield PtpMaster(process, place)
    finally:
        process.kill()
        process.wait(TIMEOUT_S)
