"""`calibrate board` on emulated pictures: from the folder to the rig file, and what it refuses."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli.calibrate import app
from processing.rig import load_rig
from sim_hw.laboratory import calibration_board as simulated

BOARD = "charuco:11x8:30mm:22mm"
POSES = 20
SMALL = (
    simulated.NOMINAL_RIG.replace("= 800", "= 480")
    .replace("= 600", "= 360")
    .replace("pitch_um = 6.0", "pitch_um = 10.0")
)


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    root = tmp_path_factory.mktemp("board")
    (root / "rig.toml").write_text(SMALL)
    rig = load_rig(root / "rig.toml")
    simulated.write_pictures(rig, simulated.drawn_board(BOARD), root, seed=1, count=POSES)
    yield root


@pytest.fixture
def pictures(taken: Path, tmp_path: Path) -> Path:
    shutil.copytree(taken / "pictures", tmp_path / "pictures")
    shutil.copy(taken / "rig.toml", tmp_path)
    return tmp_path / "pictures"


def run(folder: Path, *options: str, board: str = BOARD) -> Any:
    rig = str(folder.parent / "rig.toml")
    return CliRunner().invoke(app, ["board", str(folder), "--rig", rig, "--board", board, *options])


def calibrated(folder: Path, *options: str) -> dict[str, Any]:
    done = run(folder, "--out", str(folder.parent / "new"), "--json", *options)
    assert done.exit_code == 0, done.output
    output: dict[str, Any] = json.loads(done.stdout)
    return output


def refusal(folder: Path, *options: str, board: str = BOARD) -> str:
    done = run(folder, *options, board=board)
    assert done.exit_code != 0 and not list(folder.parent.glob("two-heads-board*"))
    return str(done.exception or done.output)


def keep(folder: Path, count: int) -> None:
    for path in [
        p for head in ("left", "right") for p in sorted((folder / head).iterdir())[count:]
    ]:
        path.unlink()


def test_pictures_of_two_heads_make_an_uncalibrated_rig_calibrated(pictures: Path) -> None:
    before = load_rig(pictures.parent / "rig.toml")
    assert not before.is_calibrated
    output = calibrated(pictures)
    rig = load_rig(pictures.parent / "new" / "rig.toml")
    assert rig.is_calibrated and rig.calibration_id == output["calibration_id"]
    truth = (
        json.loads((pictures.parent / "truth.json").read_text())
        if (pictures.parent / "truth.json").exists()
        else simulated.truth_record(simulated.true_heads(before, 1))
    )
    sigma = {(q["where"], q["what"]): q["sigma"] for q in output["quantities"]}
    assert output["figures"]["sigma_px"] < 0.02
    for name in ("left", "right"):
        cone, true = rig.cone(name), truth[name]
        assert abs(cone.lens.f_mm - true["f_mm"]) < 4.5 * sigma[name, "f"]
        for what in ("x", "y"):
            own = getattr(cone.sensors[0], f"{what}_mm")
            assert abs(own - true[f"{what}_mm"]) < 4.5 * sigma[name, what]
    degrees = np.degrees(
        np.subtract(rig.cone("right").rotation_rad, truth["right"]["rotation_rad"])
    )
    for axis, what in enumerate(("omega", "phi", "kappa")):
        assert abs(degrees[axis]) < 4.5 * sigma["right", what]
    report = (pictures.parent / "new" / "report.html").read_text()
    for part in ("left: residuals", "right: coverage", "Near focus", "Correlations beyond"):
        assert part in report
    with np.load(pictures.parent / "new" / "covariance.npz") as covariance:
        assert covariance["covariance"].shape == (len(covariance["names"]),) * 2 == (20, 20)
    focus = output["figures"]["near_focus"]["left"]
    assert focus["shift_mm"] == pytest.approx(
        focus["f_mm"] ** 2 / (1e3 * focus["distance_m"] - focus["f_mm"])
    )
    assert any("fix the focus ring" in sentence for sentence in output["verdicts"])


def test_heads_apart_stay_uncalibrated_and_are_named(pictures: Path) -> None:
    for path in (pictures / "right").iterdir():
        path.rename(path.with_stem(f"r{path.stem}"))
    output = calibrated(pictures)
    rig = load_rig(pictures.parent / "new" / "rig.toml")
    assert not rig.is_calibrated and output["figures"]["stays_uncalibrated"]
    assert output["figures"]["unconnected"] == ["right"]
    assert any("right never shows the board together" in text for text in output["warnings"])
    assert rig.cone("left").lens.f_mm != 8.0


def test_pictures_of_one_head_only_leave_the_rig_uncalibrated(pictures: Path) -> None:
    shutil.rmtree(pictures / "right")
    output = calibrated(pictures)
    assert not load_rig(pictures.parent / "new" / "rig.toml").is_calibrated
    assert any("no pictures of right" in text for text in output["warnings"])


def test_a_near_focus_is_carried_to_infinity_and_stays_uncalibrated(pictures: Path) -> None:
    output = calibrated(pictures, "--focused-at", "0.8m")
    rig = load_rig(pictures.parent / "new" / "rig.toml")
    found = {(q["where"], q["what"]): q["value"] for q in output["quantities"]}
    c = found["left", "f"]
    assert rig.cone("left").lens.f_mm == pytest.approx(1.0 / (1.0 / c + 1.0 / 800.0))
    assert not rig.is_calibrated
    assert any("focused at 0.8 m" in text for text in output["warnings"])


def test_swapped_heads_are_named(pictures: Path) -> None:
    (pictures / "left").rename(pictures / "other")
    (pictures / "right").rename(pictures / "left")
    (pictures / "other").rename(pictures / "right")
    output = calibrated(pictures)
    assert any("are swapped" in text for text in output["warnings"]), output["warnings"]


def test_a_board_of_another_size_shows_in_the_base(pictures: Path) -> None:
    done = run(
        pictures, "--out", str(pictures.parent / "new"), "--json", board="charuco:11x8:60mm:44mm"
    )
    warnings = json.loads(done.stdout)["warnings"]
    assert any("times as large as --board states" in text for text in warnings), warnings


def test_planted_pictures_are_left_out_by_name(pictures: Path) -> None:
    left = sorted((pictures / "left").iterdir())
    shutil.copy(left[0], pictures / "left" / "9001.png")
    noisy = cv2.imread(str(left[0]), cv2.IMREAD_UNCHANGED)
    noisy[0, 0] ^= 1
    cv2.imwrite(str(pictures / "left" / "9002.png"), noisy)
    again = cv2.imread(str(left[0]), cv2.IMREAD_UNCHANGED)
    blurred = cv2.GaussianBlur(np.roll(again, 5, axis=1), (0, 0), 1.0)
    cv2.imwrite(str(pictures / "left" / "9003.png"), blurred)
    mirrored = cv2.imread(str(left[4]), cv2.IMREAD_UNCHANGED)[:, ::-1]
    cv2.imwrite(str(left[4]), mirrored)
    text = "\n".join(calibrated(pictures)["warnings"])
    assert "left, picture 9001: is the same picture as 0001" in text
    assert "left, picture 9002: shows the board where 0001 does" in text
    assert "left, picture 9003: is blurred" in text
    assert f"left, picture {left[4].stem}: shows the board mirrored" in text


def test_pictures_of_another_size_are_refused(pictures: Path) -> None:
    path = pictures / "left" / "0001.png"
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), picture[:-2])
    (pictures / "left" / "0002.png").write_bytes(b"half a picture")
    text = refusal(pictures)
    assert "480 x 358 px, head left 480 x 360" in text
    assert "0002.png: cannot be read as a picture" in text


def test_one_picture_in_two_heads_is_refused(pictures: Path) -> None:
    shutil.copy(pictures / "left" / "0001.png", pictures / "right" / "0001.png")
    assert "is the same picture as left/0001.png" in refusal(pictures)


def test_too_few_pictures_are_refused_with_their_causes(pictures: Path) -> None:
    keep(pictures, 3)
    text = refusal(pictures)
    assert "of 3 pictures can be used, 4 at least are needed" in text
    assert "no marker of the board" in text


def test_folders_and_files_of_no_head_are_refused(pictures: Path) -> None:
    (pictures / "left").rename(pictures / "port")
    shutil.copy(pictures / "right" / "0001.png", pictures / "0001.png")
    text = refusal(pictures)
    assert "folder port holds pictures and is no head" in text
    assert "0001.png names no head" in text
    empty = pictures.parent / "empty"
    empty.mkdir()
    assert "no pictures" in refusal(empty)


def test_the_name_of_a_file_may_hold_the_head(pictures: Path) -> None:
    flat = pictures.parent / "flat"
    flat.mkdir()
    for head in ("left", "right"):
        for path in (pictures / head).iterdir():
            name = f"{path.stem}_{head}" if head == "left" else f"{head}-{path.stem}"
            path.rename(flat / f"{name}{path.suffix}")
    assert calibrated(flat)["figures"]["common_exposures"]["left right"] >= 3


def test_a_shipped_rig_of_several_sensors_is_sent_to_the_laboratory(pictures: Path) -> None:
    done = CliRunner().invoke(
        app, ["board", str(pictures), "--rig", "ultracam-l-mini", "--board", BOARD]
    )
    assert "calibrate lab" in str(done.exception) or done.exit_code != 0


def test_watching_prints_requests_until_no_picture_arrives(pictures: Path, tmp_path: Path) -> None:
    arriving = tmp_path / "arriving"
    (arriving / "left").mkdir(parents=True)
    (arriving / "right").mkdir()

    def deliver() -> None:
        for name in ("0001.png", "0002.png"):
            for head in ("left", "right"):
                time.sleep(0.1)
                shutil.copyfile(pictures / head / name, arriving / head / name)

    thread = threading.Thread(target=deliver)
    thread.start()
    done = run(arriving, "--watch", "--watch-timeout", "3")
    thread.join()
    assert "left, picture 0001: " in done.stderr and " corners" in done.stderr
    assert "convergent views" in done.stderr
    assert "No new picture for 3 s" in done.stderr
    assert done.exit_code != 0


def test_a_refusal_is_a_sentence_and_no_traceback(tmp_path: Path) -> None:
    from tests.daemon.diverging_camera import syntopic

    board = ("--rig", "dmc", "--board", "bad:1")
    done = syntopic("calibrate", "board", str(tmp_path), *board)
    assert done.returncode == 1
    assert "is of no known kind" in done.stderr and "Traceback" not in done.stderr
