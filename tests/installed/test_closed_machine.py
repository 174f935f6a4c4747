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
    before, _, _ = (HERE / "boot.sh").read_text("utf-8").partition("exec env -i")
    covered = re.findall(
        r"DefaultDependencies=no\\n' >/etc/systemd/system/(\w+)\.d/alone\.conf", before
    )
    assert set(covered) == {"service", "timer"}
    started = re.findall(r"systemctl start (\S+)", (HERE / "flight.sh").read_text("utf-8"))
    assert started and {unit.rpartition(".")[2] for unit in started} <= set(covered)
    for unit in (HERE / "units").iterdir():
        assert "DefaultDependencies=no" in unit.read_text("utf-8"), unit.name
