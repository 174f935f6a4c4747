"""`--fault` and `--scenario` as a user types them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_an_emulated_rig_with_impossible_faults_lists_all_of_them_and_does_not_start(
    tmp_path: Path,
) -> None:
    scenario = tmp_path / "night.toml"
    scenario.write_text('[[fault]]\nfault = "half-frame"\nat_pulse = 2\ndevice = "receiver"\n')
    done = subprocess.run(
        [
            *(sys.executable, "-m", "sim_hw", "ultracam-x-mini", "--out", str(tmp_path / "sim")),
            *("--fault", "lots@3", "--fault", "lost@3:SU99", "--scenario", str(scenario)),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 1
    assert "did you mean lost?" in done.stderr
    assert "there is no device 'SU99'" in done.stderr
    assert "night.toml: fault[0]: receiver is a receiver, which cannot have half-frame" in (
        done.stderr
    )
    assert done.stdout == ""


def test_a_single_device_refuses_a_fault_it_cannot_have(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            *(
                sys.executable,
                "-m",
                "sim_hw.processes.single_device",
                "modbus",
                "--at",
                str(tmp_path / "port"),
            ),
            *("--fault", "wrong-week@3"),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 2
    assert "wrong-week" in done.stderr
