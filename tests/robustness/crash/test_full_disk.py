"""ENOSPC from a real file system: a tmpfs of 4 MB that fills in flight and is freed again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.robustness.crash.full_disk import EXPOSURES
from tests.robustness.crash.prefixes import ROOT

NAMESPACE = ["unshare", "--user", "--map-root-user", "--mount"]


def why_not() -> str | None:
    """Why no namespace is to be had here, or None."""
    try:
        done = subprocess.run(
            [*NAMESPACE, "mount", "-t", "tmpfs", "tmpfs", "/mnt"],
            capture_output=True,
            text=True,
            timeout=30,
        )
    except FileNotFoundError:
        return "unshare is missing: apt-get install util-linux"
    return None if done.returncode == 0 else done.stderr.strip()


WHY_NOT = why_not()
# Filling the machine's own disk would be no test of ours alone.
needs_namespace = pytest.mark.skipif(
    WHY_NOT is not None, reason=f"a small disk is mounted in a namespace of its own: {WHY_NOT}"
)


@needs_namespace
def test_a_disk_that_fills_costs_what_did_not_fit_and_flight_goes_on_when_it_is_freed(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    done = subprocess.run(
        [*NAMESPACE, sys.executable, "-m", "tests.robustness.crash.full_disk", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(done.stdout)
    print(done.stdout)
    every = set(range(1, EXPOSURES + 1))
    accepted = {number for number in every if number % 4}
    # Every trigger ends in one record, whatever the disk returned meanwhile.
    assert set(figures["sealed"]) == every
    assert set(figures["stored"]) | set(figures["lost"]) == every
    assert figures["refused_frames"] == len(accepted - set(figures["stored"])) >= 1
    assert figures["refused_records"] >= 8
    assert max(figures["stored"]) == EXPOSURES, "storing goes on when there is room again"
