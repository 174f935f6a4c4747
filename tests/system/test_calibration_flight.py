"""For `make soak`: a rig that `syntopic init` wrote flies three lines and is calibrated by them.

Two emulated GigE Vision heads side by side, a trigger unit and a receiver. The lenses of the
emulated rig have distortion and other principal distances, and the right head is rotated; the
rig that is flown knows nothing of it. Takes four minutes on an idle machine with two cores.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from daemon.cli.sim import Emulator, free_first_address
from processing.rig import load_rig
from tests.system.demo_mission import syntopic

rasterio = pytest.importorskip("rasterio", reason="needs rasterio (extra geotiff)")
pytestmark = [pytest.mark.soak, pytest.mark.timeout(3600)]

WIDTH_PX: Final = 600
HEIGHT_PX: Final = 400
PITCH_UM: Final = 11.0
F_MM: Final = 12.0
ANGLE_DEG: Final = 20.0
SAMPLE_M: Final = 0.2728
GROUND_PX: Final = 5000
EXPOSURES: Final = 50
WITHIN_S: Final = 1500.0
FLIGHT: Final = (
    *("--height", "300", "--speed", "18", "--exposures", "8"),
    *("--scene-margin", "400", "--seed", "3"),
)
MOUNTING_RESIDUAL_URAD: Final = 20.0
"""Rotation of the right head that the emulator adds (docs/reference/emulator.md)."""
SIGMAS: Final = 4.0


def true_rig() -> str:
    """The rig that is emulated."""
    turned = Rotation.from_euler("XYZ", [0.0, -math.radians(ANGLE_DEG), 0.0])
    turned = turned * Rotation.from_rotvec([0.006, -0.004, 0.005])
    heads = (
        ("left", -50.0, [0.0, 0.0, 0.0], f"f_mm = {1.008 * F_MM}\nk1 = 2e-4\np1 = 1e-5"),
        (
            *("right", 50.0, turned.as_euler("XYZ").tolist()),
            f"f_mm = {0.993 * F_MM}\nk1 = 1.5e-4\np2 = -1e-5",
        ),
    )
    text = (
        'format = 1\nname = "pair"\ntitle = "true pair"\ntiming = "synchronous"\n'
        'frame_interval_s = 1.0\nmaster_cone = "left"\nreference_cone = "left"\n'
    )
    for name, right_mm, rotation, lens in heads:
        text += f"""
[[cone]]
name = "{name}"
role = "pan"
bands = ["pan"]
position_mm = [0.0, {right_mm}, 0.0]
rotation_rad = {rotation}
probe = ""
calibration_c = 20.0
[cone.lens]
{lens}
[[cone.sensor]]
name = "{name}"
width_px = {WIDTH_PX}
height_px = {HEIGHT_PX}
pitch_um = {PITCH_UM}
x_mm = 0.0
y_mm = 0.0
bits = 12
black_dn = 0.0
colour_filter_array = "none"
"""
    return text


def write_ground(path: Path) -> None:
    """Texture of several scales that nowhere repeats itself."""
    random, side = np.random.default_rng(5), GROUND_PX
    picture = np.zeros((side, side), np.float32)
    for step, weight in ((3, 0.5), (8, 1.0), (30, 1.0), (120, 0.7)):
        noise = random.random((side // step + 2,) * 2, dtype=np.float32)
        picture += weight * cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    picture = 60_000.0 * (picture - picture.min()) / np.ptp(picture)
    with rasterio.open(
        path, "w", driver="GTiff", width=side, height=side, count=1, dtype="uint16",
        crs="EPSG:32633", transform=rasterio.transform.from_origin(5e5, 5e6, SAMPLE_M, SAMPLE_M),
    ) as raster:  # fmt: skip
        raster.write(picture.astype(np.uint16), 1)


def json_of(*arguments: str) -> dict[str, Any]:
    done = syntopic(*arguments, "--json", within_s=WITHIN_S)
    assert done.returncode == 0, f"{done.stdout[-2000:]} {done.stderr[-2000:]}"
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def fly(folder: Path) -> Path:
    """Write the rig with `syntopic init` and fly it; returns the mission."""
    (folder / "true-rig.toml").write_text(true_rig())
    write_ground(folder / "ground.tif")
    emulator = Emulator(
        [
            *(str(folder / "true-rig.toml"), "--out", str(folder / "sim")),
            *("--first-address", free_first_address(), "--scene", str(folder / "ground.tif")),
            *FLIGHT,
        ]
    )
    try:
        ready = emulator.ready
        plan, rig = ready["plan"], folder / "rig"
        interval_s = plan["distance_m"] / plan["ground_speed_mps"]
        heads = [("--head", ready["heads"][name]["address"]) for name in ("left", "right")]
        json_of(
            *("init", str(rig), "--name", "pair", *heads[0], *heads[1], "--yes"),
            *("--arrangement", "side-by-side", "--focal-length", str(F_MM)),
            *("--pixel-size", str(PITCH_UM), "--angle", str(ANGLE_DEG)),
            *("--interval", f"{interval_s:.3f}", "--trigger-unit", ready["pulse_bus"]),
            *("--port", ready["receiver"]["port"]),
        )
        config = rig / "service.toml"
        text = config.read_text().partition("\n[watch]")[0] + "\n"
        text = text.replace("[trigger]", f"[trigger]\ncount = {EXPOSURES}")
        text = text.replace("[mission]", "[mission]\nend_when_done = true\nsimulated = true")
        config.write_text(text.replace("exposure_time_us = 1000.0", "exposure_time_us = 2000.0"))
        flown = syntopic("run", str(config), "--json-lines", within_s=WITHIN_S)
        assert flown.returncode == 0, flown.stderr[-2000:]
    finally:
        emulator.end()
    (mission,) = (rig / "missions").iterdir()
    return mission


def test_a_new_rig_is_calibrated_by_its_first_flight_over_the_wire(tmp_path: Path) -> None:
    mission = fly(tmp_path)
    output = json_of("calibrate", "flight", str(mission), "--out", str(tmp_path / "calibrated"))
    figures = output["figures"]
    print(json.dumps(output))
    assert figures["exposures"] > 40 and figures["sigma_px"] < 1.0
    assert not figures["stays_uncalibrated"], output["warnings"]
    assert figures["common_points"]["left right"] > 500
    rig, truth = load_rig(tmp_path / "calibrated/rig.toml"), load_rig(tmp_path / "true-rig.toml")
    assert rig.is_calibrated
    sigma = {(one["where"], one["what"]): one["sigma"] for one in output["quantities"]}
    for name in ("left", "right"):
        new, true = rig.cone(name), truth.cone(name)
        assert abs(new.lens.f_mm - true.lens.f_mm) < SIGMAS * sigma[name, "f"]
        assert sigma[name, "f"] < 0.002 * F_MM
        for key in ("k1", "k2", "p1", "p2"):
            away = abs(getattr(new.lens, key) - getattr(true.lens, key))
            assert away < SIGMAS * sigma[name, key], (name, key)
    rotation = [Rotation.from_euler("XYZ", one.cone("right").rotation_rad) for one in (rig, truth)]
    away_urad = np.abs((rotation[1].inv() * rotation[0]).as_rotvec()) * 1e6
    limit_urad = np.hypot(rig.cone("right").rotation_sigma_urad, MOUNTING_RESIDUAL_URAD)
    assert (away_urad < SIGMAS * limit_urad).all()
    propose_image(mission, tmp_path / "calibrated/rig.toml")


def propose_image(mission: Path, rig: Path) -> None:
    """Images per head without a virtual image; one stitched image with the one proposed."""
    assert not load_rig(rig).virtual_image
    images = sorted(path.name for path in (mission / "L2/000010").glob("*.tif"))
    assert images == ["left.tif", "right.tif"], images
    json_of("rigs", "propose-image", str(rig), "--write")
    assert load_rig(rig).virtual_image is not None
    again = json_of("process", str(mission), "--rig", str(rig), "--only", "10")
    (report,) = again["exposures"]
    assert report["figures"]["tie_points_pp"] > 100
