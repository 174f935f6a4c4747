"""`syntopic bench`: one object of figures, measured on an exposure rendered for it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daemon.cli.benchmark import peers
from processing.rig import find_rig


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "daemon", "bench", "ultracam-x-mini", "--json", "--runs", "2"]
    sentence = subprocess.run(
        [*command, "--no-peers", "--folder", str(folder)],
        stdout=subprocess.PIPE,
        check=True,
        timeout=240,
    )
    return dict(json.loads(sentence.stdout))


def test_figures_of_all_stages_are_reported_with_their_spread(figures: dict[str, Any]) -> None:
    stages = {"radiometry", "tie_points", "mosaic", "composition", "colour", "writing"}
    assert stages <= set(figures["stages"])
    for times in (
        *figures["stages"].values(),
        figures["pipeline"],
        figures["fixed_method"],
        figures["copy"],
    ):
        # A stage of a small rig may take less than 0.1 ms, the resolution of the report.
        assert 0.0 <= times["min_s"] <= times["median_s"] <= times["max_s"]
    assert figures["pipeline"]["min_s"] > 0.0
    assert (
        figures["realtime_factor_alone"]
        == figures["frame_interval_s"] / figures["pipeline"]["median_s"]
    )
    assert "peers" not in figures


def test_the_pace_is_that_of_parallel_exposures_with_the_latency_of_each(
    figures: dict[str, Any],
) -> None:
    side = figures["side_by_side"]
    assert side["parallel_exposures"] == 2 and side["exposures"] == 6
    pace = figures["frame_interval_s"] / side["seconds_per_exposure"]
    assert figures["realtime_factor"] == pytest.approx(pace)
    # What is overlapped takes longer than its share of the time, never less.
    assert side["latency"]["median_s"] > side["seconds_per_exposure"]
    assert side["cpu_s_per_exposure"] > 0.0


def test_what_is_timed_is_right_against_the_truth(figures: dict[str, Any]) -> None:
    assert figures["rms_px"] < 0.05 and figures["max_px"] < 0.15
    assert figures["rms_px_fixed"] > 3 * figures["rms_px"]


def test_a_peer_that_is_not_installed_is_named_with_its_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    sentence = peers.missing_programs()
    assert sentence is not None and "hugin-tools" in sentence and "enblend" in sentence


@pytest.mark.skipif(shutil.which("pano_trafo") is None, reason="Debian package hugin-tools")
def test_the_peers_geometry_of_a_rig_as_calibrated_is_that_of_a_lens_without_distortion(
    tmp_path: Path,
) -> None:
    rig = find_rig("ultracam-x-mini")
    names = [sensor.name for cone in rig.pan_cones for sensor in cone.sensors]
    image = rig.virtual_image
    assert image is not None
    ours: dict[str, NDArray[np.float64]] = {}
    expected = {}
    for name in names:
        sensor = rig.sensor(name)
        raw = np.array([[0.0, 0.0], [100.0, 200.0], [sensor.width_px - 1.0, 300.0]])
        # The peer knows where each sensor lies, and nothing of rotation, lens and temperature.
        x = (raw[:, 0] - (sensor.width_px - 1) / 2) + sensor.x_mm / sensor.pitch_mm
        y = ((sensor.height_px - 1) / 2 - raw[:, 1]) + sensor.y_mm / sensor.pitch_mm
        f = image.f_mm / rig.cone_of(name).lens.f_mm
        vip = [x * f + (image.width_px - 1) / 2, (image.height_px - 1) / 2 - y * f]
        ours |= {f"{name}.vip": np.stack(vip, axis=1), f"{name}.weight": np.ones(3)}
        expected[name] = raw
    table = peers.nona_geometry(rig, tmp_path, ours)
    for name in names:
        assert np.abs(table[f"{name}.raw"] - expected[name]).max() < 0.02


def test_the_peers_project_has_every_pan_frame_once(tmp_path: Path) -> None:
    rig = find_rig("ultracam-x-mini")
    lines = peers.project_of(rig, tmp_path).splitlines()
    frames = [line.split('n"')[1].rstrip('"') for line in lines if line.startswith("i ")]
    pan = [sensor.name for cone in rig.pan_cones for sensor in cone.sensors]
    assert [Path(frame).stem for frame in frames] == pan
