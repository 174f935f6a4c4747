"""The main job, end to end on real wire protocols: flown, captured, stitched, judged."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from mcap.records import Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from pyubx2 import UBXReader

from sim_hw.world.rendering import render_ideal
from sim_hw.world.scene import open_scene
from sim_hw.world.truth import world_of
from tests.system.demo_mission import DemoMission, syntopic

pytestmark = [pytest.mark.system, pytest.mark.timeout(400)]

WINDOW_PX = 128


def shift_px(truth: NDArray[np.float32], image: NDArray[np.float32]) -> tuple[float, float]:
    """Offset of an image from the truth, by maximising their correlation."""
    first, second = (np.ascontiguousarray(a / a.mean(), np.float32) for a in (truth, image))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-7)
    warp = np.eye(2, 3, dtype=np.float32)
    _, warp = cv2.findTransformECC(first, second, warp, cv2.MOTION_TRANSLATION, stop, None, 1)
    return float(warp[0, 2]), float(warp[1, 2])


def test_twelve_of_twelve_exposures_are_complete_and_the_ledger_balances(
    flown: DemoMission,
) -> None:
    summary = flown.summary
    assert (summary["exposures"], summary["complete"], summary["degraded"], summary["lost"]) == (
        12,
        12,
        0,
        0,
    )
    assert summary["ledger_balanced"] is True
    assert len(summary["verdicts"]) == 12
    assert set(summary["verdicts"]) <= {"good", "usable"}


def test_the_stitched_images_are_where_the_truth_is(flown: DemoMission) -> None:
    summary = flown.summary
    assert summary["rms_px"] < 0.1
    assert summary["rms_px_absolute"] < 0.15
    assert summary["rms_px_no_tdm"] > 3 * summary["rms_px"]
    assert summary["rms_px_fixed"] > summary["rms_px"]


def test_the_mission_and_its_log_say_that_it_is_simulated(flown: DemoMission) -> None:
    assert json.loads((flown.mission / "mission.json").read_text())["simulated"] is True
    for name in ("residuals.json", "mosaic.json"):
        product_json = json.loads((flown.mission / "L2/000001" / name).read_text())
        assert product_json["simulated"] is True, name
    assert 1 <= len(product_json["patterns"]["coefficients"]) <= 8
    (log,) = (flown.mission / "log").glob("*.mcap")
    with log.open("rb") as file:
        about = next(one for one in StreamReader(file).records if isinstance(one, Metadata))
    assert about.metadata["simulated"] == "true"


def test_the_displaced_sensor_is_named_in_every_exposure(flown: DemoMission) -> None:
    assert flown.summary["displaced_sensor"] == "SU02"
    assert flown.summary["displaced_sensors"] == ["SU02"] * 12


def test_every_exposure_has_the_receivers_time_and_no_other(flown: DemoMission) -> None:
    assert flown.summary["time_error_ns"] == 0
    assert flown.summary["time_sigma_ns"] < 1000
    for path in (flown.mission / "L0").glob("*/exposure.json"):
        record = json.loads(path.read_text())
        assert record["mark_source"] == "event-mark"
        assert all(frame["time_source"] == "event-mark" for frame in record["frames"])


def test_every_frame_has_its_own_syntopic_instant_close_to_the_truth(flown: DemoMission) -> None:
    record = json.loads((flown.mission / "L0/000004/exposure.json").read_text())
    truth = np.load(flown.truth / "000004.npz")
    for frame in record["frames"]:
        true_ns = int(truth[f"{frame['sensor']}.mid_gps_ns"])
        assert abs(int(frame["mid_exposure_gps_ns"]) - true_ns) < 2_000, frame["sensor"]


def test_the_virtual_image_shows_what_an_ideal_camera_would_see(flown: DemoMission) -> None:
    """Image against image: the truth is rendered, and both are correlated in windows."""
    number = 6
    pan = tifffile.imread(flown.mission / f"L2/{number:06d}/pan.tif").astype(np.float32)
    truth = np.load(flown.truth / f"{number:06d}.npz")
    world = world_of(flown.truth)
    scene = open_scene(world.scene_settings, flown.scenes)
    flight = world.flight.beginning_first_line_at(float(truth["first_line_at_m"]))
    ideal = render_ideal(world, scene, flight, int(truth["master_mid_gps_ns"]))
    shifts = []
    height, width = pan.shape
    for row in range(60, height - WINDOW_PX - 60, 250):
        for column in range(60, width - WINDOW_PX - 60, 250):
            part = (slice(row, row + WINDOW_PX), slice(column, column + WINDOW_PX))
            shifts.append(shift_px(ideal[part], pan[part]))
    measured = np.array(shifts)
    assert len(measured) > 100
    assert np.sqrt(np.mean(measured**2, axis=0)).max() < 0.08
    assert np.abs(measured).max() < 0.25


def test_the_mission_verifies_and_a_flipped_bit_is_found(
    flown: DemoMission, tmp_path: Path
) -> None:
    verified = syntopic("verify", str(flown.mission), "--json")
    assert verified.returncode == 0, verified.stdout
    assert json.loads(verified.stdout)["frames"] == 156
    copy = tmp_path / flown.mission.name
    shutil.copytree(flown.mission, copy, ignore=shutil.ignore_patterns("L2"))
    frame = copy / "L0/000003/SU11.tif"
    frame.chmod(0o644)
    content = bytearray(frame.read_bytes())
    content[100_000] ^= 4
    frame.write_bytes(content)
    altered = syntopic("verify", str(copy), "--json")
    assert altered.returncode == 1
    (problem,) = json.loads(altered.stdout)["problems"]
    assert "SU11" in problem


def test_processing_again_gives_the_same_image_and_the_same_figures(
    flown: DemoMission, tmp_path: Path
) -> None:
    copy = tmp_path / flown.mission.name
    # The overlap follows from the exposure before it.
    ignored = shutil.ignore_patterns("L2", "00000[!45]*", "00001*")
    shutil.copytree(flown.mission, copy, ignore=ignored)
    (copy / "L2").mkdir()
    again = syntopic("process", str(copy), "--only", "5", "--json")
    assert again.returncode == 0, again.stderr[-2000:]
    (report,) = json.loads(again.stdout)["exposures"]
    flown_report = json.loads((flown.mission / "L2/000005/quality.json").read_text())
    assert report["figures"] == flown_report["figures"]
    np.testing.assert_array_equal(
        tifffile.imread(copy / "L2/000005/pan.tif"),
        tifffile.imread(flown.mission / "L2/000005/pan.tif"),
    )


def test_an_exposure_written_by_hand_is_processed(flown: DemoMission, tmp_path: Path) -> None:
    """Only TIFFs that tifffile wrote and a rig file: no record, no log, no index."""
    folder = tmp_path / "by-hand"
    (folder / "L0/000001").mkdir(parents=True)
    shutil.copy(flown.mission / "rig.toml", folder / "rig.toml")
    for path in (flown.mission / "L0/000002").glob("*.tif"):
        tifffile.imwrite(folder / "L0/000001" / path.name, tifffile.imread(path))
    service = (flown.mission / "service.toml").read_text()
    radiometry = next(line for line in service.splitlines() if line.startswith("radiometry"))
    done = syntopic(*("process", str(folder), "--radiometry", radiometry.split('"')[1], "--json"))
    assert done.returncode == 0, done.stderr[-2000:]
    (report,) = json.loads(done.stdout)["exposures"]
    assert report["figures"]["tie_points_pp"] > 1000
    assert "TEMPERATURE_MISSING" in report["flags"]
    assert tifffile.imread(folder / "L2/000001/pan.tif").shape == (2226, 3480)


def test_the_receivers_bytes_come_out_whole_for_other_programs(flown: DemoMission) -> None:
    done = syntopic("export", "raw", str(flown.mission), "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    with (Path(summary["folder"]) / "gnss.ubx").open("rb") as stream:
        kinds = [message.identity for _, message in UBXReader(stream, protfilter=2)]
    assert kinds.count("TIM-TM2") == 12
    assert kinds.count("NAV-PVT") > 100
    assert summary["events"] == 12


def test_the_report_is_self_contained_and_names_the_sensor(flown: DemoMission) -> None:
    html = Path(flown.summary["report"]).read_text()
    assert "Simulated flight" in html
    assert "Displaced sensor: SU02" in html
    assert 'src="http' not in html and 'href="http' not in html


def test_the_log_of_the_mission_has_the_settings_that_every_head_holds(flown: DemoMission) -> None:
    (log,) = (flown.mission / "log").glob("*.mcap")
    opened: dict[str, dict[str, Any]] = {}
    with log.open("rb") as file:
        for one in StreamReader(file).records:
            if isinstance(one, Message) and b'"name":"opened"' in one.data:
                event = json.loads(one.data)
                opened[event["device"]] = event
    heads = [name for name in opened if opened[name]["sentence"].startswith("The head ")]
    assert len(heads) == 13
    for name in heads:
        held = opened[name]["settings"]
        assert str(held["PixelFormat"]).startswith("Mono"), name
        assert held["TriggerMode"] == "On" and {"ExposureTime", "Gain"} <= held.keys(), name
