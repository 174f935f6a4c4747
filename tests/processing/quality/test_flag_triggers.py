"""Each flag is raised by what it is there for, at twice its threshold, and by nothing else.

The faults are in the light, the true camera, the probes or the instruments of a rendered exposure;
flags of capture are provoked in tests/robustness/faults. Rates over many exposures:
docs/reference/results/accuracy.md.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from benchmarks.flags import FAULTS, THRESHOLDS, Camera, Fault
from processing.pipelines.stitched import Conditions
from processing.quality.report import NO_FLAGS, Flag, Verdict
from processing.quality.requirements import QualityRequirements

SEED = 50_001
pytestmark = pytest.mark.timeout(600)

FAULTY = (
    *("dark", "saturated", "defocused", "no-detail"),
    # In a shorter run test_pipeline_emulated and test_degraded_mode raise these two.
    pytest.param("displaced", marks=pytest.mark.soak),
    pytest.param("stuck-probe", marks=pytest.mark.soak),
)


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Camera:
    return Camera(tmp_path_factory.mktemp("scenes"), places=1)


def test_a_clean_exposure_raises_nothing(camera: Camera) -> None:
    report = camera.product(SEED, None).report
    assert report.flags == NO_FLAGS and report.verdict is Verdict.GOOD


@pytest.mark.parametrize("name", FAULTY)
def test_a_fault_raises_its_flag(camera: Camera, name: str) -> None:
    report = camera.product(SEED, FAULTS[name]).report
    assert report.flags & FAULTS[name].flag, report.figures
    allowed = FAULTS[name].flag
    if name == "no-detail":
        # Sensors that see nothing are dark or bright alike, and their detail cannot be judged.
        allowed |= Flag.BLUR
    if name == "no-detail":
        # Heads that see an even light are brighter than their neighbours, most so in the dark.
        allowed |= Flag.OVEREXPOSED | Flag.FRAME_CORRUPT
    assert not report.flags & ~allowed, report.findings


def _everything(conditions_in: Conditions) -> Conditions:
    """Instruments report twice the limit of every figure."""
    probes = dict(conditions_in.temperatures_c) | {
        "1": None,
        "2": 2 * THRESHOLDS.temperature_high_c,
    }
    turning = FAULTS["turning"].conditions(conditions_in)
    return replace(
        turning,
        temperatures_c=probes,
        temperature_age_s=dict.fromkeys(probes, 2 * THRESHOLDS.temperature_age_s),
        roll_rad=2 * THRESHOLDS.tilt_rad,
        crab_rad=-2 * THRESHOLDS.crab_rad,
        time_sigma_ns=2 * round(THRESHOLDS.time_sigma_ns),
        forward_overlap=0.3,
        sun_elevation_rad=math.radians(15.0),
    )


def test_what_instruments_report_raises_its_flags(
    camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The emulated camera flies for a GSD three times as wide.
    requirements = QualityRequirements(forward_overlap=0.6, sun_deg=30.0, gsd_m=0.1)
    monkeypatch.setattr(
        camera.pipeline, "settings", replace(camera.pipeline.settings, requirements=requirements)
    )
    fault = Fault(NO_FLAGS, "all instruments at once", conditions=_everything)
    report = camera.product(SEED, fault).report
    probes = Flag.TEMPERATURE_MISSING | Flag.TEMPERATURE_RANGE | Flag.TEMPERATURE_STALE
    project = Flag.OVERLAP | Flag.SUN | Flag.GSD
    assert report.flags == probes | project | Flag.TILT | Flag.DRIFT | Flag.BLUR | Flag.TIME_SIGMA
