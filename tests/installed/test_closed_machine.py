"""The machine that `boot.sh` starts leaves the host as it was: its scripts are read, not run."""

from __future__ import annotations

import re
from pathlib import Path

HERE = Path(__file__).parent
WRITTEN = ("/run", "/var/lib", "/var/log", "/opt", "/tmp", "/var/tmp")
"""What systemd sets up or empties at boot."""


def test_what_systemd_writes_is_not_the_hosts() -> None:
    before, started, _ = (HERE / "boot.sh").read_text("utf-8").partition("exec env -i")
    assert started
    mounted = re.findall(r"^mount -t tmpfs tmpfs (/\S+)$", before, re.MULTILINE)
    listed = re.search(r"for place in (.*); do\n +mount -t tmpfs", before)
    assert listed is not None
    assert set(WRITTEN) <= {*mounted, *listed[1].split()}


def test_nothing_is_started_that_would_set_up_the_host() -> None:
    """Units with default dependencies pull in sysinit.target, which empties /tmp."""
    units = {unit.name: unit.read_text("utf-8") for unit in (HERE / "units").iterdir()}
    assert all("DefaultDependencies=no" in text for text in units.values())
    started = re.findall(r"systemctl start (\S+)", (HERE / "flight.sh").read_text("utf-8"))
    assert started
    assert set(started) <= units.keys() | {"syntopic.service"}  # which has flight.conf
