"""The stages of every pipeline: their order, what each receives, and the report."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from processing.geometry.conditions import Conditions
from processing.pipelines.exposure_pipeline import (
    ExposureInput,
    ExposurePipeline,
    Judgement,
    Stages,
    StageSettings,
    Stopwatch,
)
from processing.quality.figures.circumstances import GeometryFigures
from processing.quality.figures.image import SignalFigures, ValidAreaFigures
from processing.quality.figures.stitching import MethodFigures
from processing.quality.report import Flag, QualityReport, Thresholds, Verdict
from processing.quality.requirements import QualityRequirements
from processing.quality.valid_area import area_of
from processing.rig import Rig, find_rig

RIG = find_rig("rededge")
UNCALIBRATED = replace(RIG, calibration_date="")
FRAMES = {sensor.name: np.zeros((2, 2), np.uint16) for sensor in RIG.sensors}


class Recorded(ExposurePipeline[StageSettings, str, str, str, QualityReport]):
    """Records its stages; each hands on its name."""

    def __init__(self, settings: StageSettings | None = None, rig: Rig = RIG) -> None:
        super().__init__(rig, settings or StageSettings())
        self.stages: list[str] = []
        self.threads = 0

    def clone(self) -> Recorded:
        return Recorded(self.settings)

    def warm_up(self) -> None:
        self.process(FRAMES, Conditions())

    def _correct(self, exposure: ExposureInput) -> str:
        self.threads = numba.get_num_threads()
        self.stages.append("correct")
        return "corrected"

    def _adjust(self, exposure: ExposureInput, corrected: str) -> str:
        self.stages.append(f"adjust {corrected}")
        return "adjusted"

    def _resample(self, exposure: ExposureInput, corrected: str, adjusted: str) -> str:
        self.stages.append(f"resample {corrected} {adjusted}")
        return "image"

    def _judge(self, stages: Stages[str, str, str]) -> Judgement:
        self.stages.append(f"judge {stages.corrected} {stages.adjusted} {stages.image}")
        gap = np.zeros((4, 4), np.bool_)
        gap[:, :1] = True
        figures = [None, SignalFigures(bright_fraction=0.05)]
        return Judgement("test", figures, area_of({"red": gap}), ("blue",), ())

    def _product(
        self, stages: Stages[str, str, str], judgement: Judgement, report: QualityReport
    ) -> QualityReport:
        self.stages.append(f"product {judgement.method} {report.verdict.value}")
        return report


def test_stages_follow_each_other_and_frames_are_released_after_the_correction() -> None:
    pipeline = Recorded()
    pipeline.process(
        FRAMES, Conditions(), frames_read=lambda: pipeline.stages.append("frames read")
    )
    assert pipeline.stages == [
        "correct",
        "frames read",
        "adjust corrected",
        "resample corrected adjusted",
        "judge corrected adjusted image",
        "product test usable",
    ]


def test_the_report_has_figures_of_conditions_stages_and_valid_area() -> None:
    frames = {name: frame for name, frame in FRAMES.items() if name != "R"}
    report = Recorded().process(frames, Conditions(roll_rad=0.01, simulated=True))
    assert report.figures.of(MethodFigures) == MethodFigures("test", ("R",))
    assert report.figures.of(GeometryFigures).tilt_deg == pytest.approx(np.degrees(0.01))
    assert report.figures.of(SignalFigures).bright_fraction == 0.05
    worst = report.figures.of(ValidAreaFigures)
    assert worst.valid_worst_band == "red" and worst.valid_worst_fraction == pytest.approx(0.75)
    raised = Flag.FRAME_MISSING | Flag.UNDEREXPOSED | Flag.TIE_POINTS | Flag.SIMULATED
    assert report.flags & raised == raised and report.verdict is Verdict.USABLE
    assert any("Too few tie points for blue" in one.sentence for one in report.findings)


def test_thresholds_requirements_and_threads_are_those_of_the_settings() -> None:
    settings = StageSettings(
        threads=1,
        thresholds=Thresholds(bright_fraction=0.01),
        requirements=QualityRequirements(tilt_deg=0.1),
    )
    pipeline = Recorded(settings)
    report = pipeline.process(FRAMES, Conditions(roll_rad=0.01))
    assert not report.flags & Flag.UNDEREXPOSED and report.flags & Flag.TILT
    assert report.verdict is Verdict.REFLY and pipeline.threads == 1


def test_parts_of_a_stage_are_added_up(monkeypatch: pytest.MonkeyPatch) -> None:
    instants_s = iter([1.0, 1.5, 2.0, 4.0, 7.0, 7.25])
    monkeypatch.setattr(
        "processing.pipelines.exposure_pipeline.time.perf_counter", lambda: next(instants_s)
    )
    clock = Stopwatch()
    for stage in ("radiometry", "resampling", "radiometry"):
        with clock.stage(stage):
            pass
    assert clock.seconds == {"radiometry": 0.75, "resampling": 2.0}


def test_no_exposure_of_an_uncalibrated_rig_is_good() -> None:
    """What only the pipeline knows: the conditions state nothing of a calibration."""
    calibrated = Recorded().process(FRAMES, Conditions())
    report = Recorded(rig=UNCALIBRATED).process(FRAMES, Conditions())
    assert report.flags == calibrated.flags | Flag.UNCALIBRATED
    assert report.verdict is not Verdict.GOOD
    assert any("calibrate the camera" in finding.sentence for finding in report.findings)
