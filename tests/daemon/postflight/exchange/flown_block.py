"""Missions of the emulated flight without rendering: records, empty images and the true trajectory.

Pixels of ground points come from the emulator's own camera (`sim_hw.world.true_camera`), places in
the local frame from PROJ, so that nothing of what is tested computes the expected values.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import tifffile

from daemon.mission.store.level0 import tiff_parts
from processing.rig import Rig, load_rig, shipped_rigs
from sim_hw.world.flight import FlightPlan, SimulatedFlight
from sim_hw.world.true_camera import BODY_FROM_CAMERA, TrueCamera, projection_centre_m

EPOCH_NS = 1_479_300_000_000_000_000
# Where the UTM grid is as long as the ground, 180 km east of its meridian; north leans by 1.7 deg.
PLAN = FlightPlan(
    height_m=1000.0,
    ground_speed_mps=60.0,
    line_length_m=2000.0,
    line_spacing_m=500.0,
    heading_deg=37.0,
    latitude_deg=47.07,
    longitude_deg=17.37,
    attitude_rms_deg=2.0,
)
FLIGHT = SimulatedFlight(PLAN, seed=3, epoch_gps_ns=EPOCH_NS)
SIGMA_M = (0.05, 0.05, 0.08)
LENS = "f_number = 4.0\nk1 = -5e-5\nk2 = 1e-8\np1 = 1e-5\np2 = -6e-6\nb1 = 1e-5"


@dataclass(frozen=True)
class FlownBlock:
    """A mission folder, its rig, trajectory and marks by exposure number."""

    path: Path
    rig: Rig
    trajectory: Path
    marks: dict[int, int]

    def truth(self) -> TrueCamera:
        """The camera as the rig file has it."""
        return TrueCamera(
            self.rig,
            {s.name: (0.0, 0.0) for s in self.rig.sensors},
            {c.name: (0.0, 0.0, 0.0) for c in self.rig.cones},
        )


def fly(
    folder: Path,
    rig_name: str,
    *,
    seconds: tuple[float, ...],
    lens: str = LENS,
    is_syntopic: bool = False,
) -> FlownBlock:
    """Records of exposures at some seconds of the flight, with images of one grey."""
    text = shipped_rigs()[rig_name].read_text()
    text = re.sub(r"^f_number = .*$", lens, text, flags=re.MULTILINE)
    # Heads expose where the reference head was: the foremost first.
    text = re.sub(
        r"^(?:mark_to_mid_exposure_ns = .*\n)?(position_mm = \[ *(-?[\d.]+).*)$",
        lambda m: f"{m[1]}\nmark_to_mid_exposure_ns = {-round(float(m[2]) * 1e6 / 60.0)}",
        text,
        flags=re.MULTILINE,
    ) if is_syntopic else text  # fmt: skip
    folder.mkdir()
    (folder / "rig.toml").write_text(text)
    (folder / "service.toml").write_text("[plan]\nground_height_m = 395.0\n")
    rig = load_rig(folder / "rig.toml")
    marks = {n: EPOCH_NS + round(s * 1e9) for n, s in enumerate(seconds, 1)}
    rows = ["gps_ns,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"]
    instants = set()
    for number, mark in marks.items():
        level0, level2 = folder / f"L0/{number:06d}", folder / f"L2/{number:06d}"
        level0.mkdir(parents=True)
        level2.mkdir(parents=True)
        frames = []
        for cone in rig.cones:
            mid = mark + cone.mark_to_mid_exposure_ns
            instants.add(mid)
            for sensor in cone.sensors:
                frames.append({"sensor": sensor.name, "mid_exposure_gps_ns": str(mid)})
                grey = np.full((sensor.height_px, sensor.width_px), 1000, np.uint16)
                tifffile.imwrite(level0 / f"{sensor.name}.tif", grey, compression="zlib")
            if rig.virtual_image is None:
                grey = np.full(
                    (cone.sensors[0].height_px, cone.sensors[0].width_px), 1000, np.uint16
                )
                _write(level2 / f"{cone.name}.tif", [grey] * len(cone.bands), list(cone.bands))
        if rig.virtual_image is not None:
            image = rig.virtual_image
            grey = np.full((image.height_px, image.width_px), 1000, np.uint16)
            _write(level2 / "pan.tif", [grey], ["pan"])
            small = np.full((image.colour_height_px, image.colour_width_px), 1000, np.uint16)
            names = ["red", "green", "blue", "nir"]
            planes = [small * k for k in range(1, 5)]
            _write(level2 / "rgbn.tif", planes, names)
        record = {
            "number": number,
            "mark_gps_ns": str(mark),
            "mark_sigma_ns": 25,
            "mark_source": "event-mark",
            "simulated": True,
            "line_id": f"line {1 + (number - 1) // 2}",
            "frames": frames,
        }
        (level0 / "exposure.json").write_text(json.dumps(record))
    for gps_ns in sorted(instants | {i + d for i in instants for d in (-(10**7), 10**7)}):
        pose = FLIGHT.pose(gps_ns)
        latitude, longitude, height = FLIGHT.geodetic(pose.position_enu_m)
        angles = [math.degrees(a) for a in FLIGHT.attitude_rad(pose)]
        rows.append(",".join(map(repr, [gps_ns, latitude, longitude, height, *angles])))
    (folder / "trajectory.csv").write_text("\n".join(rows) + "\n")
    return FlownBlock(folder, rig, folder / "trajectory.csv", marks)


def _write(path: Path, planes: list[np.ndarray], bands: list[str]) -> None:
    parts = tiff_parts([np.ascontiguousarray(p & 0xFFFE) for p in planes], {"bands": bands})
    path.write_bytes(b"".join(bytes(p) for p in parts))


def local_of_world(world_enu_m: np.ndarray, origin: dict) -> np.ndarray:
    """Places of the emulator's world in a topocentric frame, by PROJ's own operation."""
    to_local = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        "+step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={origin['longitude_deg']!r} "
        f"+lat_0={origin['latitude_deg']!r} +h_0=0"
    )
    places = [FLIGHT.geodetic(point) for point in np.atleast_2d(world_enu_m)]
    return np.array([to_local.transform(lon, lat, height) for lat, lon, height in places])


def targets(flown: FlownBlock, cone_name: str, mark_ns: int, pixels: np.ndarray, *, raw: bool):
    """World points that a cone sees at its pixels, 1500 m away, and its projection centre."""
    cone = flown.rig.cone(cone_name)
    sensor = cone.sensors[0]
    pose = FLIGHT.pose(mark_ns + cone.mark_to_mid_exposure_ns)
    centre = projection_centre_m(cone, pose)
    if raw:
        seen = flown.truth().directions(
            cone, sensor, pixels[:, 0], pixels[:, 1],
            sensor_c=sensor.calibration_c, cone_c=cone.calibration_c,
        )  # fmt: skip
    else:
        image = flown.rig.virtual_image
        width, height, pitch_um, f_mm = (
            (sensor.width_px, sensor.height_px, sensor.pitch_um, cone.lens.f_mm)
            if image is None
            else (image.width_px, image.height_px, image.pitch_um, image.f_mm)
        )
        mm = (pixels - [(width - 1) / 2, (height - 1) / 2]) * pitch_um * 1e-3 * [1, -1]
        seen = np.column_stack([mm, np.full(len(mm), -f_mm)])
        seen = seen @ flown.truth().master_from_cone(cone).T
    rays = seen @ (pose.enu_from_body @ BODY_FROM_CAMERA).T
    return centre + rays / np.linalg.norm(rays, axis=1)[:, None] * 1500.0, centre
