"""A rig file with placeholders for radiometric values is refused before anything is rendered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from daemon.postflight.calibration.rig_writer import rig_toml
from processing.rig import Rig, find_rig, shipped_rigs
from sim_hw.processes.exposures import main, radiometry_problem

MINI = find_rig("ultracam-x-mini")


def with_values(**values: float) -> Rig:
    """The camera with one sensor of other radiometric values."""
    first = MINI.cones[0]
    sensors = (replace(first.sensors[0], **values), *first.sensors[1:])
    return replace(MINI, cones=(replace(first, sensors=sensors), *MINI.cones[1:]))


@pytest.mark.parametrize("name", shipped_rigs())
def test_shipped_rigs_can_be_rendered(name: str) -> None:
    assert radiometry_problem(find_rig(name)) is None


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"black_dn": 0.0}, "black_dn = 0 cuts the noise of dark pixels off at 0 DN"),
        ({"black_dn": 6.4}, "it is 6.4 at least"),
        ({"electrons_per_dn": 0.4, "read_noise_e": 0.0}, "fills 12 bits with 1638 electrons"),
    ],
)
def test_impossible_values_are_named(values: dict[str, float], sentence: str) -> None:
    problem = radiometry_problem(with_values(**values))
    assert problem is not None and sentence in problem
    assert "SU00" in problem and "Give black_dn" in problem


def test_limits_are_four_sigmas_of_dark_pixels_and_2000_electrons() -> None:
    # Read noise 30 e at 20 e/DN, 0.3 DN of pixels and 0.5 DN of columns.
    assert radiometry_problem(with_values(black_dn=6.45)) is None
    assert radiometry_problem(with_values(electrons_per_dn=0.49, read_noise_e=0.0)) is None


def test_the_command_refuses_such_a_rig_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "rig.toml", tmp_path / "flight"
    file.write_bytes(rig_toml(with_values(black_dn=0.0)))
    assert main([str(file), "--out", str(out)]) == 2
    assert "sensor SU00: black_dn = 0" in capsys.readouterr().err
    assert not out.exists()
