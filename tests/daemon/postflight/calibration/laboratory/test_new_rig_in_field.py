"""`calibrate lab` of a rig that `syntopic init` wrote, and of one that `calibrate board` did."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli.calibrate import app
from daemon.initialization.answers import Answers, Arrangement
from daemon.initialization.rig_text import rig_text
from daemon.postflight.calibration.rig_writer import rig_toml
from processing.rig import Rig, load_rig
from sim_hw.laboratory import calibration_field
from sim_hw.world.true_camera import rotation_opk
from tests.daemon.initialization.heads import head

HEADS = ("left", "right")
FIELD = calibration_field.FieldPlan(count=(25, 17), size_m=(5.2, 3.6), exposures=8)


def new_rig(folder: Path) -> bytes:
    """Two heads that look 20 degrees apart; no calibration, no [virtual_image]."""
    heads = [head(n, width_px=800, height_px=600) for n in (1, 2)]
    answers = Answers("pair", Arrangement.SIDE_BY_SIDE, heads, [12.0] * 2, [7.0] * 2, 20.0, 100.0)
    text = rig_text(answers, written_by="syntopic init")
    (folder / "new.toml").write_text(text)
    return text.encode()


def rig_of_board(folder: Path) -> bytes:
    """The same with values where `calibrate board` writes them."""
    new_rig(folder)
    cones = [
        replace(
            cone,
            lens=replace(cone.lens, f_mm=12.0 * stretch, k1=2e-4, k2=-1e-6, f_sigma_ppm=90.0),
            sensors=(replace(cone.sensors[0], x_mm=0.05, y_mm=-0.03, position_sigma_um=0.8),),
        )
        for cone, stretch in zip(load_rig(folder / "new.toml").cones, (1.006, 0.995), strict=True)
    ]
    rig = replace(
        load_rig(folder / "new.toml"),
        cones=tuple(cones),
        calibration_id="pair-board-2026-11-20",
        calibration_date="2026-11-20",
    )
    return rig_toml(rig)


@pytest.mark.parametrize("begun_with", [new_rig, rig_of_board])
def test_frames_of_the_field_calibrate_a_rig_that_began_so(
    begun_with: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A focal length as printed on the lens is off by a part in two hundred.
    monkeypatch.setattr(calibration_field, "SCALE", 5e-3)
    monkeypatch.setattr(calibration_field, "SHIFT_MM", 0.03)
    monkeypatch.setattr(calibration_field, "CONE_RAD", 2e-3)
    file = tmp_path / "rig.toml"
    file.write_bytes(begun_with(tmp_path))
    before = load_rig(file)
    assert before.is_calibrated is (begun_with is rig_of_board) and before.virtual_image is None
    calibration_field.write_series(before, file, tmp_path / "field", seed=1, plan=FIELD)
    out = tmp_path / "lab"
    done = CliRunner().invoke(
        app, ["lab", str(tmp_path / "field" / "series"), "--out", str(out), "--json"]
    )
    assert done.exit_code == 0, f"{done.output} {done.exception}"
    output: dict[str, Any] = json.loads(done.stdout)
    assert output["figures"]["sigma_px"] < 0.02
    rig, truth = load_rig(out / "rig.toml"), calibration_field.true_rig(before, 1)
    assert rig.is_calibrated and rig.calibration_id == output["calibration_id"]
    _compare(
        rig, before, truth, {(q["where"], q["what"]): q["sigma"] for q in output["quantities"]}
    )


def _compare(
    rig: Rig,
    before: Rig,
    truth: calibration_field.TrueRig,
    sigma: dict[tuple[str, str], float],
) -> None:
    for name in HEADS:
        new, old, true = rig.sensor(name), before.sensor(name), truth.sensors[name]
        assert abs(true.scale) > 5e-4
        errors = {
            "x": 1e3 * (new.x_mm - old.x_mm - true.shift[0]),
            "y": 1e3 * (new.y_mm - old.y_mm - true.shift[1]),
            "scale": 1e6 * (new.scale / old.scale / (1.0 + true.scale) - 1.0),
        }
        for what, error in errors.items():
            assert abs(error) < 4.0 * sigma[name, what], (name, what, error)
    turned = truth.master_from_cone(before.cone("right"))
    found = rotation_opk(rig.cone("right").rotation_rad)
    assert float(np.abs(turned.T @ found - np.eye(3)).max()) < 1e-4
