"""A rig without `[calibration]`: it is processed, and every product states that it is
uncalibrated."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from daemon.configuration.model import Configuration, MountSection, ProcessingSection
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.onboard.preflight.check_results import CheckOutcome
from daemon.onboard.preflight.prerequisites import calibration
from daemon.orientation.in_flight_orientation import orientation_json
from daemon.postflight.calibration.platform_calibration import (
    PlatformCalibrationError,
    read_missions,
)
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.postflight.calibration.thermal_calibration import (
    ThermalCalibrationError,
    read_thermal_records,
)
from daemon.postflight.export.camera_certificate import CameraCertificateError, certificate_of
from daemon.products.exposure_products import report_unprocessed
from daemon.products.processor import build_processor
from processing.calibration.platform import PlatformCalibration, calibrated_rig
from processing.geometry.conditions import Conditions
from processing.pipelines.perspective import has_head_images
from processing.pipelines.synthetic_frames import synthetic_head_frames
from processing.quality.report import Flag
from processing.rig import Rig, RigError, find_rig, rig_from_mapping
from tests.daemon.diverging_camera import RIG_TOML

CONTENT = tomllib.loads(RIG_TOML)
CALIBRATED = rig_from_mapping(CONTENT, "rig.toml")


def without_calibration(content: dict[str, Any]) -> Rig:
    return rig_from_mapping({k: v for k, v in content.items() if k != "calibration"}, "rig.toml")


UNCALIBRATED = without_calibration(CONTENT)


def test_a_rig_without_calibration_is_named_after_its_values() -> None:
    assert CALIBRATED.is_calibrated and not UNCALIBRATED.is_calibrated
    assert UNCALIBRATED.calibration_id.startswith("uncalibrated-")
    other = without_calibration({**CONTENT, "frame_interval_s": 2.0})
    assert other.calibration_id != UNCALIBRATED.calibration_id
    assert without_calibration(dict(reversed(CONTENT.items()))) == UNCALIBRATED


def test_no_calibration_may_be_called_uncalibrated() -> None:
    named = {**CONTENT, "calibration": {"id": "uncalibrated-1", "date": "2026-11-01"}}
    with pytest.raises(RigError, match=r"leave out \[calibration\]"):
        rig_from_mapping(named, "rig.toml")


def test_a_rig_written_again_is_still_uncalibrated() -> None:
    again = rig_from_mapping(tomllib.loads(rig_toml(UNCALIBRATED).decode()), "rig.toml")
    assert not again.is_calibrated and again.cones == UNCALIBRATED.cones


def products(rig: Rig) -> tuple[dict[str, Any], dict[str, bytes]]:
    processor = build_processor(rig, ProcessingSection(), None, None)
    frames = synthetic_head_frames(rig)
    report, contents = processor.make(Exposure(1), frames, Conditions())
    return report, {name: b"".join(map(bytes, parts)) for name, parts in contents.items()}


@pytest.mark.parametrize("kind", ["heads", "bands"])
def test_every_product_states_that_the_rig_is_uncalibrated(kind: str) -> None:
    rig = UNCALIBRATED
    if kind == "bands":
        bands = find_rig("rededge")
        small = tuple(
            replace(cone, sensors=(replace(cone.sensors[0], width_px=192, height_px=128),))
            for cone in bands.cones
        )
        rig = replace(bands, cones=small, calibration_date="")
    assert has_head_images(rig) is (kind == "heads")
    report, contents = products(rig)
    assert "UNCALIBRATED" in report["flags"] and report["verdict"] != "good"
    images = [name for name in contents if name.endswith(".tif")]
    assert len(images) >= len(rig.cones)
    for name in images:
        assert b'"uncalibrated":true' in contents[name].replace(b" ", b""), name
    assert b"UNCALIBRATED" in contents["quicklook.jpg"][:200]
    assert b"UNCALIBRATED" in contents["thumbnail.jpg"][:200]


def test_products_of_a_calibrated_rig_do_not_state_it() -> None:
    report, contents = products(CALIBRATED)
    assert "UNCALIBRATED" not in report["flags"]
    assert not any(b"ncalibrated" in content.lower() for content in contents.values())


def test_an_exposure_without_image_states_it_as_well() -> None:
    report = report_unprocessed(UNCALIBRATED, Exposure(1), Flag(0))
    assert "UNCALIBRATED" in report["flags"]
    orientation = orientation_json(Exposure(1), UNCALIBRATED, MountSection(), 0.0)
    assert orientation["uncalibrated"] is True
    assert "uncalibrated" not in orientation_json(Exposure(1), CALIBRATED, MountSection(), 0.0)


def test_no_partial_calibration_makes_an_uncalibrated_rig_calibrated(tmp_path: Path) -> None:
    mission = Mission.create(
        tmp_path,
        "diverging",
        service_toml=b"",
        rig_toml=rig_toml(UNCALIBRATED),
        started_utc=datetime(2026, 11, 21, tzinfo=UTC),
    )
    with pytest.raises(ThermalCalibrationError, match="uncalibrated rig"):
        read_thermal_records([mission.path])
    with pytest.raises(PlatformCalibrationError, match=r"no \[virtual_image\].*calibrate flight"):
        read_missions([mission.path])
    angles = PlatformCalibration(cones=(), missing=())
    found = calibrated_rig(UNCALIBRATED, angles, calibration_id="p-1", date="2026-11-24")
    assert not found.is_calibrated
    found = calibrated_rig(CALIBRATED, angles, calibration_id="p-1", date="2026-11-24")
    assert found.is_calibrated and found.calibration_id == "p-1"


def test_there_is_no_certificate_of_nominal_values() -> None:
    with pytest.raises(CameraCertificateError, match="is uncalibrated"):
        certificate_of(UNCALIBRATED)


def test_the_check_before_a_flight_warns_and_passes(tmp_path: Path) -> None:
    configuration = Configuration.model_validate(
        {
            "mission": {"root": str(tmp_path), "rig": "rig.toml"},
            "trigger": {"driver": "software"},
            "head": [{"sensor": "LEFT", "driver": "folder"}],
        }
    )
    (result,) = calibration(configuration, UNCALIBRATED)
    assert result.outcome is CheckOutcome.PASS and "uncalibrated" in result.sentence
    assert "syntopic calibrate flight MISSION" in result.sentence
    assert json.dumps(result.as_json())


def test_heads_of_the_same_band_are_images_of_their_own() -> None:
    cones = [replace(cone, rotation_rad=(0.0, 0.0, 0.0)) for cone in UNCALIBRATED.cones]
    parallel, first = replace(UNCALIBRATED, cones=tuple(cones)), cones[0]
    assert has_head_images(parallel)
    single = replace(UNCALIBRATED, cones=(first,))
    assert has_head_images(single)
    colour = tuple(replace(cone, role="colour", bands=("red",)) for cone in parallel.cones)
    assert has_head_images(replace(parallel, cones=colour))
    red, nir = colour[0], replace(colour[1], bands=("nir",))
    registered = replace(parallel, cones=(red, nir), colour_master_cone=red.name)
    assert not has_head_images(registered)
    with_pan = replace(registered, cones=(red, replace(parallel.cones[1], name="pan")))
    assert not has_head_images(with_pan)
