"""The benchmark of capture alone, short and small: its counts are correct, and it can fail."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.ring_heads import HEADER_PX, RING, build_ring, is_intact, number_of
from processing.rig import find_rig

REPOSITORY = Path(__file__).parents[2]
RIG = "rededge"
"""Five heads of 1280 x 960: the smallest there is."""


def ring_of(folder: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    build_ring(RIG, None, folder)
    sensor = find_rig(RIG).sensors[0]
    return np.fromfile(folder / f"{sensor.name}.raw", "<u2").reshape(
        RING, sensor.height_px, sensor.width_px
    )


def test_frames_of_the_ring_are_distinguished_and_damage_is_detected(tmp_path: Path) -> None:
    ring = ring_of(tmp_path)
    assert [is_intact(frame) for frame in ring] == [True] * RING
    assert [number_of(frame) for frame in ring] == [0] * RING, "numbered when they are exposed"
    assert not np.array_equal(ring[0, 1], ring[1, 1])
    ring[1, 700, 3] ^= 1
    assert not is_intact(ring[1])
    ring[2, 0, :HEADER_PX] = 0
    assert number_of(ring[2]) is None


@pytest.mark.system
@pytest.mark.timeout(300)
def test_capture_alone_loses_nothing_and_reports_its_cost(tmp_path: Path) -> None:
    pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
    command = [sys.executable, "-m", "benchmarks.capture", "--rig", RIG, "--noise", "--json"]
    done = subprocess.run(
        [*command, "--exposures", "4", "--interval", "2.5", "--root", str(tmp_path)],
        env=os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")},
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr}"
    output = json.loads(done.stdout)
    assert output["nothing_lost"]
    assert output["triggers"]["complete"] == 4
    assert output["frames_exposed"] == output["frames_sent"] == 4 * 5
    assert output["checked"] == 4
    assert output["fully_checked"] == 1
    processes = {"service", "writer", "capture", "worker", "heads 1", "heads 2"}
    assert set(output["cpu_s"]) == processes
    assert output["cpu_s"]["capture"] > 0
    assert list(tmp_path.glob("syntopic-capture-*")) == [], "nothing is left"
