"""`rigs propose-image`: proposed, written with its comments, and stitched with."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from daemon.cli.rigs import app
from daemon.initialization.rig_edits import RigEditError, with_virtual_image
from daemon.postflight.calibration.head_refinement import HeadRefinementError
from processing.geometry.image_proposal import propose_image
from processing.geometry.rotation import rotation_matrix, vectors_from_rotations
from processing.rig import load_rig, rig_from_mapping
from sim_hw.processes import exposures

RIG = """\
#:schema ./rig.schema.json
# pair: two heads, side-by-side
format = 1
name = "pair"
title = ""
timing = "synchronous"      # all heads are triggered at one instant
frame_interval_s = 2.0
master_cone = "left"    # angles of the others count from it
reference_cone = "left"
""" + "".join(
    f"""
[[cone]]
name = "{name}"
role = "pan"
bands = ["pan"]
position_mm = [0.0, {right}, 0.0]    # P: forward, right, down
rotation_rad = [0.0, {phi}, 0.0]
# P: omega, phi, kappa against the master: 0 {degrees} 0 degrees
probe = ""               # no temperature probe
calibration_c = 20.0     # P

[cone.lens]
f_mm = 12.0    # P: as printed on the lens

[[cone.sensor]]
name = "{name}"
width_px = 640
height_px = 480
pitch_um = 7.0
x_mm = 0.0
y_mm = 0.0
bits = 12
black_dn = 64.0
electrons_per_dn = 20.0
read_noise_e = 30.0
"""
    for name, right, phi, degrees in (("left", -40.0, 0.0, 0), ("right", 40.0, -0.279252680, -16))
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


def run(file: Path, *options: str) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["propose-image", str(file), "--json", *options])
    assert done.exit_code == 0, (done.output, done.exception)
    output: dict[str, Any] = json.loads(done.stdout)
    return output


def test_nothing_is_changed_without_write(file: Path) -> None:
    output = run(file)
    assert file.read_text() == RIG and output["written"] is None
    printed = CliRunner().invoke(app, ["propose-image", str(file)])
    assert "# overlap; the frame is the image" in printed.stdout
    for part in ("1111", "2222", "####", "Nothing is changed"):
        assert part in printed.stdout
    assert file.read_text() == RIG


def test_the_written_file_keeps_comments_and_is_the_proposed_rig(file: Path) -> None:
    output = run(file, "--write")
    text = file.read_text()
    rig = load_rig(file)
    assert rig.virtual_image is not None and rig.master_cone is None and not rig.is_calibrated
    assert rig.virtual_image.width_px == output["virtual_image"]["width_px"]
    for comment in (
        "# all heads are triggered at one instant",
        "# P: as printed on the lens",
        "# P: forward, right, down",
        '# master_cone = "left"',
        "# Proposed by `syntopic rigs propose-image rig.toml`",
        "# omega, phi, kappa against the virtual camera",
    ):
        assert comment in text
    assert "against the master" not in text
    again = CliRunner().invoke(app, ["propose-image", str(file), "--write"])
    assert again.exit_code != 0 and file.read_text() == text


def test_the_boresight_next_to_the_file_is_carried_over(file: Path) -> None:
    (file.parent / "service.toml").write_text("[mount]\nboresight_deg = [8.0, 0.0, 0.0]\n")
    output = run(file)
    assert output["boresight_deg"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    printed = CliRunner().invoke(app, ["propose-image", str(file)]).stdout
    assert "boresight_deg = " in printed


def test_a_file_of_another_form_is_not_changed(file: Path) -> None:
    several = RIG.replace("rotation_rad = [0.0, 0.0, 0.0]", "rotation_rad = [\n0.0, 0.0, 0.0]")
    rig = rig_from_mapping(tomllib.loads(several), "rig.toml")
    with pytest.raises(RigEditError, match=r"one key a line|on lines of their own"):
        with_virtual_image(several, propose_image(rig), written_by="test")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pair")
    (root / "rig.toml").write_text(RIG)
    arguments = [str(root / "rig.toml"), "--out", str(root / "flight"), "--exposures", "2"]
    assert exposures.main([*arguments, "--seed", "5"]) == 0
    return root / "flight" / "mission"


def test_a_flight_is_stitched_with_the_written_rig(file: Path, flown: Path) -> None:
    from daemon.cli import app as whole

    run(file, "--write")
    done = CliRunner().invoke(whole, ["process", str(flown), "--rig", str(file), "--json"])
    assert done.exit_code in (0, 1), (done.output, done.exception)
    reports = json.loads(done.stdout)["exposures"]
    assert len(reports) == 2
    for report in reports:
        assert "UNCALIBRATED" in report["flags"], report["flags"]
    rig = load_rig(file)
    assert rig.virtual_image is not None

    pixels = tifffile.imread(flown / "L2" / "000001" / "pan.tif")
    assert pixels.shape == (rig.virtual_image.height_px, rig.virtual_image.width_px)
    assert float(np.mean(pixels > 0)) > 0.98


def test_the_frames_of_a_mission_refine_the_rotations(file: Path, flown: Path) -> None:
    true = rotation_matrix(*load_rig(file).cone("right").rotation_rad)
    wrong = RIG.replace("-0.279252680", "-0.265").replace(
        "rotation_rad = [0.0, -0.265, 0.0]", "rotation_rad = [0.006, -0.265, 0.01]"
    )
    file.write_text(wrong)
    output = run(file, "--mission", str(flown))
    assert output["refined"]["right"]["ties"] > 40
    left, right = (rotation_matrix(*output["rotation_rad"][name]) for name in ("left", "right"))
    off = float(np.linalg.norm(vectors_from_rotations(true.T @ left.T @ right)))
    assert off < 0.0008, off  # 1.4 px; the nominal file was off by 0.018


def test_a_mission_without_tie_points_is_refused(file: Path, tmp_path: Path, flown: Path) -> None:

    bare = tmp_path / "bare"
    shutil.copytree(flown, bare)
    for path in bare.glob("L0/*/right.tif"):
        tifffile.imwrite(path, np.full((480, 640), 300, np.uint16))
    done = CliRunner().invoke(app, ["propose-image", str(file), "--mission", str(bare)])
    assert isinstance(done.exception, HeadRefinementError)
    assert "right: fewer than 20 tie points" in str(done.exception)
