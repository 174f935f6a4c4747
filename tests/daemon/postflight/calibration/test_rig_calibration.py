"""`syntopic calibrate rig`: a block becomes a dated rig file; the shipped one is table 2."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from benchmarks.rig_calibration import write_block
from daemon.cli import app
from processing.geometry.rotation import phi_omega_kappa, rotation_matrix
from processing.rig import find_rig, load_rig
from sim_hw.blocks.oblique import TABLE_2_GRAD, simulate_oblique_block, table_2_rotation

RUN = CliRunner()
GRAD = 200.0 / math.pi


def test_the_shipped_rig_is_table_2_of_the_paper() -> None:
    for name in ("midas", "midas-mini"):
        rig = find_rig(name)
        assert rig.virtual_image is None and rig.timing == "synchronous"
        assert rig.cone("nadir").lens.f_mm == 23.8
        for head, listed in TABLE_2_GRAD.items():
            cone = rig.cone(head)
            assert cone.lens.f_mm == 51.0
            rotation = rotation_matrix(*cone.rotation_rad)
            angles = np.array(phi_omega_kappa(rotation)) * GRAD
            assert np.abs(angles - np.array(listed)).max() < 1e-5, head
            assert np.abs(rotation - table_2_rotation(head)).max() < 1e-7
            assert 44.1 < math.degrees(math.acos(rotation[2, 2])) < 46.3


def test_a_block_becomes_a_dated_rig_that_is_compared_and_never_overwritten(
    tmp_path: Path,
) -> None:
    block = simulate_oblique_block(1)
    write_block(tmp_path / "block", seed=1)
    out = tmp_path / "first"
    arguments = ["calibrate", "rig", str(tmp_path / "block"), "--rig", "midas", "--json"]
    done = RUN.invoke(app, [*arguments, "--out", str(out)])
    assert done.exit_code == 0, done.output
    output = json.loads(done.stdout)
    new_rig = load_rig(out / "rig.toml")
    assert new_rig.calibration_id == output["calibration_id"]
    assert new_rig.calibration_id.startswith("first-")
    for k, head in enumerate(("nadir", *TABLE_2_GRAD)):
        cone = new_rig.cone(head)
        turn = rotation_matrix(*cone.rotation_rad).T @ block.head_rotation[k]
        assert math.degrees(math.acos(min(1.0, (np.trace(turn) - 1) / 2))) < 0.2
        # The lens is the block's, as far as this control can resolve.
        sigma = {q["what"]: q["sigma"] for q in output["quantities"] if q["where"] == head}
        assert abs(cone.lens.k1 - block.radial[k][0]) < 4.0 * sigma["k1"] < 3e-5
        assert abs(cone.lens.f_mm - cone.lens.df_mm - block.f_mm[k]) < 0.1
    grads = {q["where"]: q for q in output["quantities"] if q["what"] == "omega"}
    assert grads["5"]["unit"] == "grad" and 0.01 < grads["5"]["sigma"] < 0.1
    again = RUN.invoke(app, [*arguments, "--out", str(out)])
    assert again.exit_code != 0
    compared = RUN.invoke(
        app, [*arguments, "--out", str(tmp_path / "second"), "--previous", str(out)]
    )
    assert not any(c["significant"] for c in json.loads(compared.stdout)["changes"])


def test_cameras_that_are_no_cones_of_the_rig_are_an_error_that_states_so(tmp_path: Path) -> None:
    write_block(tmp_path / "block", seed=1)
    done = RUN.invoke(
        app,
        ["calibrate", "rig", str(tmp_path / "block"), "--rig", "rededge", "--reference", "nadir"],
    )
    assert done.exit_code != 0
    assert "no cones of rig rededge" in str(done.exception) + done.output
