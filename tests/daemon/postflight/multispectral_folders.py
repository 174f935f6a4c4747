"""Folders of multispectral cameras by maker, as their images are tagged, and their import."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import PlanSection
from daemon.mission.layout import Mission
from daemon.mission.store.store import load_level0
from daemon.postflight.importers.multispectral import import_multispectral
from daemon.postflight.importers.multispectral_tags import ImagesError
from daemon.products.band_images import radiance_of
from daemon.products.exposure_conditions import conditions_of
from processing.geometry.placement import vip_mm_from_raw
from processing.image.band_registration import band_placements
from processing.pipelines.bands import BandPipeline, BandProduct
from processing.quality.report import Flag
from processing.rig import load_rig
from tests.daemon.multispectral_data import write_image, xmp

RUN = CliRunner()
SIZE = (320, 240)
DEWARP = "2022-04-05;1913.333,1913.333,10.5,-7.25,-0.35,0.15,0.0003,-0.0002,-0.05"


def scene_pixels() -> np.ndarray:
    """Fields of several sizes, with detail for the registration; words of 16 bits."""
    random = np.random.default_rng(3)
    grey = sum(
        cv2.resize(random.normal(0, 1.0, (h, h * 4 // 3)).astype(np.float32), SIZE) * 500
        for h in (6, 12, 30, 60, 120)
    )
    return np.clip(12000 + grey, 4200, 60000).astype(np.uint16)


def sequoia(folder: Path, scene, band: str, name: str, capture: str = "C1", **changes) -> None:
    """Parrot Sequoia: a fisheye in Pix4D's namespace, 10 bits at the top of a word."""
    wavelength = {"Green": 550, "Red": 660, "Red edge": 735, "NIR": 790}[band]
    values = {
        "BandName": band, "CentralWavelength": str(wavelength), "WavelengthFWHM": "40",
        "ModelType": "fisheye", "PrincipalPoint": "0.61,0.44", "CaptureUUID": capture,
        "FisheyePolynomial": "0,1,-0.025178575,0.167834214",
        "FisheyeAffineMatrix": "463.0,0,0,463.0",
        "SensorModel": "1000.0,60.0,0.1", **changes.pop("tags", {}),
    }  # fmt: skip
    values = {key: value for key, value in values.items() if value}
    more = {"serial": "PS1", "per_mm": 1 / 0.00375, **changes}
    write_image(folder / name, scene & 0xFFC0, xmp(values), make="Parrot", model="Sequoia", **more)


def dji(folder: Path, scene, band: str, name: str, model: str = "M3M", **changes) -> None:
    """DJI: Brown's model about the optical centre plus an offset, in attributes."""
    values = {
        "BandName": band, "CentralWavelength": "560(+/-16)nm", "DewarpData": DEWARP,
        "CalibratedOpticalCenterX": "160.0", "CalibratedOpticalCenterY": "120.0",
        "CaptureUUID": "U1", "DroneSerialNumber": "D1", **changes.pop("tags", {}),
    }  # fmt: skip
    values = {key: value for key, value in values.items() if value}
    more = {"black": 4096, "focal_mm": 5.74, **changes}
    packet = xmp(values, as_attributes=True)
    write_image(folder / name, scene, packet, make="DJI", model=model, **more)


def micasense(folder: Path, scene, band: str, name: str, model: str, serial: str, **changes):
    values = {
        "BandName": band, "CentralWavelength": "560", "WavelengthFWHM": "27",
        "ModelType": "perspective", "PrincipalPoint": "0.6,0.45",
        "PerspectiveFocalLength": "5.5", "PerspectiveFocalLengthUnits": "mm",
        "PerspectiveDistortion": "-0.1,0.1,0,0.0002,0.0003", "CaptureId": "cap1",
        "RadiometricCalibration": "1e-4,1e-7,1e-6", "VignettingCenter": "160,120",
        "VignettingPolynomial": "0,0,0,0,0,0", **changes.pop("tags", {}),
    }  # fmt: skip
    values = {key: value for key, value in values.items() if value is not None}
    more = {"black": 4800, "per_mm": 1 / 0.00345, **changes}
    write_image(
        folder / name, scene & 0xFFF0, xmp(values), make="MicaSense", model=model,
        serial=serial, **more,
    )  # fmt: skip


def imported(folder: Path, out: Path) -> list[dict]:
    done = RUN.invoke(app, ["import", "multispectral", str(folder), "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output + str(done.exception)
    return json.loads(done.stdout)["cameras"]


def refused(folder: Path, out: Path) -> str:
    with pytest.raises(ImagesError) as error:
        import_multispectral(folder, out)
    assert not out.exists()
    return str(error.value)


def ideal(rig, sensor: str, pixels: np.ndarray) -> np.ndarray:
    """Ideal points of raw pixels, x right, y down, in units of the focal length."""
    placement = band_placements(rig, {})[sensor]
    return vip_mm_from_raw(placement, pixels) / rig.cone("G").lens.f_mm * [1, -1]


def processed(path: Path, number: int) -> BandProduct:
    mission = Mission.open(path)
    rig = load_rig(mission.rig_path)
    frames, exposure = load_level0(mission.level0(number), rig)
    conditions = conditions_of(exposure, rig, PlanSection.model_validate({}), Flag(0))
    radiance = radiance_of(rig, mission.path / "radiometry")
    return BandPipeline(rig, radiance).process(frames, conditions)


PIXELS = np.stack(np.meshgrid(np.linspace(0, 319, 9), np.linspace(0, 239, 7)), -1).reshape(-1, 2)
