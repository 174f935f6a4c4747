"""The device of the configuration reaches the pipelines; one that is not there is refused."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from pydantic import ValidationError

from daemon.cli.process import flown_processing
from daemon.configuration.model import Configuration, ConfigurationError, ProcessingSection
from daemon.mission.layout import Mission
from daemon.onboard.preflight.check_results import CheckOutcome
from daemon.onboard.preflight.prerequisites import CHECKS_AFTER_RESTART, accelerator
from daemon.products.processor import build_processor
from processing.image.accelerator import devices
from processing.image.accelerator.devices import AcceleratorError, Device, with_same_pixels
from processing.image.accelerator.fixed_resampling import resample_fixed
from processing.image.resampling import resample
from processing.rig import find_rig

RIG = find_rig("ultracam-x-mini")
HEADS = find_rig("midas-mini")


@pytest.fixture
def without_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_cuda_fault", lambda: "no such device can be used (no driver)")


@pytest.mark.parametrize("rig", [RIG, HEADS], ids=["stitched", "heads"])
@pytest.mark.parametrize(
    ("device", "function"), [("cpu", resample), ("cuda-reference", resample_fixed)]
)
def test_the_device_chooses_the_kernels_of_every_pipeline_with_frames_to_resample(
    rig: object, device: Device, function: object
) -> None:
    processor = build_processor(
        HEADS if rig is HEADS else RIG, ProcessingSection(device=device), None, None
    )
    assert processor.pipeline.kernels.resample is function
    assert processor.clone().pipeline.kernels.resample is function


def test_a_service_with_a_device_that_is_not_there_does_not_start(without_device: None) -> None:
    configuration = Configuration.model_construct(processing=ProcessingSection(device="cuda"))
    (result,) = accelerator(configuration, RIG)
    assert (result.outcome, result.is_blocking) == (CheckOutcome.FAIL, True)
    assert "no driver" in result.sentence and 'set device = "cpu"' in result.sentence
    assert accelerator in CHECKS_AFTER_RESTART
    with pytest.raises(AcceleratorError, match="no driver"):
        build_processor(RIG, ProcessingSection(device="cuda"), None, None)


def test_a_device_that_is_there_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_cuda_fault", lambda: None)
    configuration = Configuration.model_construct(processing=ProcessingSection(device="cuda"))
    assert [result.outcome for result in accelerator(configuration, RIG)] == [CheckOutcome.PASS]
    assert with_same_pixels("cuda") == "cuda"


def test_the_processor_needs_no_check() -> None:
    for device in ("cpu", "cuda-reference"):
        section = ProcessingSection.model_validate({"device": device})
        assert not list(accelerator(Configuration.model_construct(processing=section), RIG))


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(ValidationError, match="'cpu', 'cuda' or 'cuda-reference'"):
        ProcessingSection.model_validate({"device": "gpu"})


def test_after_landing_the_processor_computes_the_pixels_of_the_device(
    without_device: None, tmp_path: Path
) -> None:
    mission = _mission(tmp_path, b'[processing]\ndevice = "cuda"\nthreads = 7\n')
    flown = ProcessingSection.model_validate(flown_processing(mission))
    assert (flown.device, flown.threads) == ("cuda", 2)
    assert with_same_pixels(flown.device) == "cuda-reference"


def test_a_mission_without_the_key_is_processed_as_before(tmp_path: Path) -> None:
    assert flown_processing(_mission(tmp_path, b"")) == {"thresholds": {}, "device": "cpu"}


def test_a_device_of_the_flown_configuration_that_is_unknown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"processing\.device"):
        flown_processing(_mission(tmp_path, b'[processing]\ndevice = "tpu"\n'))


def _mission(folder: Path, service_toml: bytes) -> Mission:
    return Mission.create(
        folder / "missions",
        RIG.name,
        rig_toml=b"",
        service_toml=service_toml,
        started_utc=datetime(2026, 11, 29, tzinfo=UTC),
    )
