"""A flight inside the hardened unit, booted by a systemd of its own.

The machine is this one's kernel and files in namespaces (PID, mount, cgroup, hostname); everything
that is written goes to memory. Kernels are compiled first, so it takes minutes.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile

import pytest

ROOT = Path(__file__).parents[2]
LIMIT_S = 2400

pytestmark = [pytest.mark.soak, pytest.mark.timeout(LIMIT_S + 60)]


def needed() -> str | None:
    """What is missing here for a systemd of our own; None where nothing is."""
    if os.geteuid() != 0:
        return "needs root, for namespaces and mounts"
    if not Path("/lib/systemd/systemd").exists() or shutil.which("unshare") is None:
        return "needs Debian's systemd and util-linux"
    tried = subprocess.run(
        [
            "unshare",
            "--pid",
            "--fork",
            "--mount",
            "--cgroup",
            "mount",
            "-t",
            "cgroup2",
            "x",
            "/mnt",
        ],
        capture_output=True,
        timeout=30,
        check=False,
    )
    return None if tried.returncode == 0 else "needs a kernel that lets cgroup2 be mounted"


def boot(place: Path) -> dict[str, str]:
    """Boot, fly, power off; the facts that flight.sh printed."""
    variables = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "PLACE": str(place),
        "REPOSITORY": str(ROOT),
        "PYTHON": sys.base_prefix,
        "PACKAGES": sysconfig.get_path("purelib"),
    }
    with _control_group() as group, (place / "boot.out").open("wb") as out:
        subprocess.run(
            [
                *("sh", "-c", f'echo $$ >{group}/cgroup.procs; exec "$@"', "sh"),
                *("unshare", "--pid", "--fork", "--kill-child", "--mount", "--uts", "--ipc"),
                *("--cgroup", "bash", str(ROOT / "tests/installed/boot.sh")),
            ],
            env=variables,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            timeout=LIMIT_S,
            check=False,
        )
    lines = (place / "flight.out").read_text("utf-8").splitlines()
    return dict(line.split("=", 1) for line in lines if "=" in line)


@contextmanager
def _control_group() -> Iterator[Path]:
    """A control group of its own, so that systemd's leave nothing behind among the host's."""
    mounts = [line.split() for line in Path("/proc/mounts").read_text("utf-8").splitlines()]
    mounted = next(Path(fields[1]) for fields in mounts if fields[2] == "cgroup2")
    group = mounted / f"syntopic-test-{os.getpid()}"
    group.mkdir()
    try:
        yield group
    finally:
        below = sorted((p for p in group.rglob("*") if p.is_dir()), key=lambda p: -len(p.parts))
        for folder in (*below, group):
            folder.rmdir()


def test_a_flight_passes_inside_the_hardened_unit(tmp_path: Path) -> None:
    missing = needed()
    if missing is not None:
        pytest.skip(missing)
    with NamedTemporaryFile(prefix="not-of-this-machine-") as of_the_host:
        results = boot(tmp_path)
        assert Path(of_the_host.name).exists()
    stderr_tail = (tmp_path / "service.err").read_text("utf-8")[-2000:]
    assert results["kernels"] == "0"
    assert (results["health_started"], results["health_result"]) == ("0", "success")
    assert (results["health_file"], results["health_folder"]) == ("root 644", "root 755")
    assert (results["health_read"], results["health_planted"]) == ("1", "1")
    assert results["health_by_timer"] == "1"
    assert results["started"] == "0", stderr_tail
    assert results["user"] == "syntopic"
    assert (results["NoNewPrivs"], results["Seccomp"], int(results["CapEff"], 16)) == ("1", "2", 0)
    assert results["oom_policy"] == "continue"
    assert (results["page_user"], results["page_killed"]) == ("syntopic", "0")
    assert (results["result"], results["status"]) == ("success", "0"), stderr_tail
    assert (results["sealed"], results["processed"]) == ("4", "4")
    assert results["verified"] == "0"
