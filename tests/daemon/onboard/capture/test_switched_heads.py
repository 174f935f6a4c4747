"""Thirteen heads behind one port of a switch: with the link budget nothing is lost.

The service flies as it does; bridge and port (`tbf`: rate, buffer, drop tail) are the kernel's.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.switch import SwitchError, switch
from processing.rig import rig_file
from tests.support.stopwatch import slowdown

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(180)]

RATE_MBPS = 600
INTERVAL_S = 0.5
"""On idle cores; on a busy machine the emulated heads need longer for their frames, too."""
TIMEOUT_S = 150.0


def flown(tmp_path: Path, exposures: int, *more: str) -> dict[str, Any]:
    """Figures of a flight of the mini rig at a shorter frame interval."""
    pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
    try:
        with switch(1, RATE_MBPS, 131_072):
            pass
    except SwitchError as error:
        pytest.skip(f"no switch of the kernel here: {error}")
    shipped = Path(rig_file.__file__).parent / "files" / "ultracam-x-mini.toml"
    text = shipped.read_text(encoding="utf-8")
    rig = tmp_path / "fast.toml"
    factor = slowdown()
    interval_s = INTERVAL_S * factor
    rig.write_text(text.replace("frame_interval_s = 1.35", f"frame_interval_s = {interval_s:.3f}"))
    ended = subprocess.run(
        [
            *(sys.executable, "-m", "benchmarks.capture", "--rig", str(rig), "--noise", "--json"),
            *("--exposures", str(exposures), "--depth", "8", "--rate", "125"),
            *("--switch-mbps", str(RATE_MBPS), *more),
        ],
        check=False,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S * factor,
    )
    assert ended.stdout, ended.stderr
    found: dict[str, Any] = json.loads(ended.stdout)
    return found


def test_paced_heads_lose_no_frame_and_fill_no_buffer(tmp_path: Path) -> None:
    found = flown(tmp_path, 15)
    assert found["nothing_lost"], found
    assert found["frames_of_ledger"]["used"] == 15 * 13
    # A packet that meets a full buffer is the exception; unpaced, most do.
    assert found["switch"]["packets_dropped"] <= 0.005 * found["packets_sent"]


@pytest.mark.soak
def test_unpaced_heads_lose_packets_of_every_exposure(tmp_path: Path) -> None:
    found = flown(tmp_path, 3, "--unpaced")
    assert found["switch"]["packets_dropped"] > 0.5 * found["packets_sent"]
