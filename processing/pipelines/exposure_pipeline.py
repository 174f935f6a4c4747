"""The stages of every pipeline: read, correct, adjust, resample, judge.

The order, the threads, what is known of the exposure and the report are the same for all kinds of
rig and are decided here. A kind of rig implements the stages.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from processing.geometry.conditions import (
    Conditions,
    UsableTemperatures,
    condition_figures,
    usable_temperatures,
)
from processing.geometry.exposure_times import implausible_exposure_times
from processing.image.accelerator.devices import DEFAULT_DEVICE, Device
from processing.image.accelerator.pixel_kernels import PixelKernels, pixel_kernels
from processing.quality.evaluation import evaluate
from processing.quality.figures import FigureGroup, QualityFigures
from processing.quality.figures.circumstances import ImplausibleExposureFigures
from processing.quality.figures.stitching import MethodFigures
from processing.quality.report import NO_FLAGS, Flag, QualityReport, Thresholds
from processing.quality.requirements import QualityRequirements
from processing.quality.valid_area import ValidArea, valid_area_figures
from processing.radiometry.corrector import Corrector
from processing.radiometry.level1 import FrameStatistics, level1_from_level0
from processing.rig import Rig

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class StageSettings:
    """How exposures are processed, whatever the rig.

    `device` makes the pixels of stitched images and of separate heads; everything else is computed
    by the processor.
    """

    threads: int = 2
    device: Device = DEFAULT_DEVICE
    thresholds: Thresholds = field(default_factory=Thresholds)
    requirements: QualityRequirements = field(default_factory=QualityRequirements)


class Stopwatch:
    """`seconds` by the name of each stage that has ended, in order; a stage may be in parts."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is done inside a `with` block.

        Args:
            name: of the stage; the seconds of several blocks of one name are added.

        Yields:
            Nothing.
        """
        began = time.perf_counter()
        try:
            yield
        finally:
            seconds = time.perf_counter() - began
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds


@dataclass(frozen=True)
class ExposureInput:
    """Everything one exposure is computed from, and the clock of its stages.

    `frames` are Level-0 by sensor name, (h, w) uint16. `implausible_exposures` names the frames
    whose exposure time cannot be; `conditions` have none of them.
    """

    frames: Mapping[str, Array]
    conditions: Conditions
    temperatures: UsableTemperatures
    clock: Stopwatch = field(default_factory=Stopwatch)
    kernels: PixelKernels = field(default_factory=lambda: pixel_kernels(DEFAULT_DEVICE))
    implausible_exposures: tuple[str, ...] = ()

    def correct(
        self,
        corrector: Corrector,
        *,
        out: Array,
        tdi_shifts: int = 0,
        scale: float = 1.0,
        measure_lines: bool = False,
        unclean: Array | None = None,
    ) -> FrameStatistics:
        """Level-1 of one frame.

        Args:
            corrector: calibration of the sensor.
            out: (h, w) uint16, written.
            tdi_shifts: of the frame.
            scale: factor of the signal.
            measure_lines: whether the means of bundles along lines are wanted.
            unclean: marks of the frame's blocks (`processing.radiometry.unclean_blocks`), written.

        Returns:
            What the correction counted and measured in the frame.
        """
        sensor = corrector.sensor
        return level1_from_level0(
            corrector,
            np.ascontiguousarray(self.frames[sensor.name]),
            temperature_c=self.temperatures.placement_temperatures_c.get(sensor.probe),
            exposure_time_s=self.conditions.exposure_time_s.get(sensor.name, 0.0),
            tdi_shifts=tdi_shifts,
            scale=scale,
            out=out,
            measure_lines=measure_lines,
            unclean=unclean,
            passes=self.kernels.passes,
        )


@dataclass(frozen=True)
class Judgement:
    """What a pipeline found out about an exposure: material of its report.

    `nominal_bands` are placed by calibration because too few tie points were found,
    `mismatched_bands` those of them that have texture that does not match.
    """

    method: str
    figures: Iterable[FigureGroup | None]
    valid_area: ValidArea
    nominal_bands: tuple[str, ...] = ()
    mismatched_bands: tuple[str, ...] = ()


SettingsT = TypeVar("SettingsT", bound=StageSettings)
CorrectedT = TypeVar("CorrectedT")
AdjustedT = TypeVar("AdjustedT")
ImageT = TypeVar("ImageT")
ProductT = TypeVar("ProductT")


@dataclass(frozen=True)
class Stages(Generic[CorrectedT, AdjustedT, ImageT]):
    """One exposure, and what the stages made of it."""

    exposure: ExposureInput
    corrected: CorrectedT
    adjusted: AdjustedT
    image: ImageT


class ExposurePipeline(ABC, Generic[SettingsT, CorrectedT, AdjustedT, ImageT, ProductT]):
    """A rig with its calibrations and settings; one exposure at a time.

    The type parameters are the settings, and what each stage hands on.
    """

    def __init__(self, rig: Rig, settings: SettingsT) -> None:
        self.rig = rig
        self.settings = settings
        self.kernels = pixel_kernels(settings.device)
        self._correctors: dict[str, Corrector] = {}

    @property
    def correctors(self) -> dict[str, Corrector]:
        """Calibrations by sensor name; one may be replaced by an equal one in other memory."""
        return self._correctors

    def process(
        self,
        frames: Mapping[str, Array],
        conditions: Conditions,
        *,
        frames_read: Callable[[], None] | None = None,
    ) -> ProductT:
        """Make the images of one exposure and evaluate it.

        Args:
            frames: Level-0 frames by sensor name, (h, w) uint16. A missing one leaves a gap.
            conditions: what else is known of the exposure.
            frames_read: called once the pixels of `frames` are no longer needed.

        Returns:
            The product; pixel arrays that belong to the pipeline hold until the next call.

        Raises:
            ValueError: a frame of the wrong shape or type, or conditions that cannot be used.
        """
        _limit_threads(self.settings.threads)
        exposure = self._read(frames, conditions)
        corrected = self._correct(exposure)
        if frames_read is not None:
            frames_read()
        adjusted = self._adjust(exposure, corrected)
        image = self._resample(exposure, corrected, adjusted)
        stages = Stages(exposure, corrected, adjusted, image)
        judgement = self._judge(stages)
        return self._product(stages, judgement, self._report(exposure, judgement))

    @abstractmethod
    def clone(self) -> ExposurePipeline[SettingsT, CorrectedT, AdjustedT, ImageT, ProductT]:
        """Another pipeline for an exposure at the same time.

        Returns:
            A pipeline that shares the calibrations and has buffers of its own.
        """

    @abstractmethod
    def warm_up(self) -> None:
        """Compile every kernel a flight will need, from the cache where there is one."""

    def _read(self, frames: Mapping[str, Array], conditions: Conditions) -> ExposureInput:
        """What is known of the exposure."""
        temperatures = usable_temperatures(self.rig, conditions, self.settings.thresholds)
        times_s = conditions.exposure_time_s
        implausible = implausible_exposure_times(self.rig, times_s)
        if implausible:
            known_s = {name: time_s for name, time_s in times_s.items() if name not in implausible}
            conditions = replace(conditions, exposure_time_s=known_s)
        return ExposureInput(
            frames,
            conditions,
            temperatures,
            kernels=self.kernels,
            implausible_exposures=implausible,
        )

    @abstractmethod
    def _correct(self, exposure: ExposureInput) -> CorrectedT:
        """Radiometry; the last stage that reads the pixels of the frames."""

    @abstractmethod
    def _adjust(self, exposure: ExposureInput, corrected: CorrectedT) -> AdjustedT:
        """Matching and adjustment: where every frame lies."""

    @abstractmethod
    def _resample(
        self, exposure: ExposureInput, corrected: CorrectedT, adjusted: AdjustedT
    ) -> ImageT:
        """The images, each resampled once."""

    @abstractmethod
    def _judge(self, stages: Stages[CorrectedT, AdjustedT, ImageT]) -> Judgement:
        """Figures and valid area; figures of the conditions are added to them."""

    def _report(self, exposure: ExposureInput, judgement: Judgement) -> QualityReport:
        """Flags and verdict."""
        conditions, temperatures = exposure.conditions, exposure.temperatures
        missing = self._missing(exposure)
        figures = QualityFigures(
            MethodFigures(judgement.method, missing),
            *condition_figures(self.rig, conditions, temperatures),
            *judgement.figures,
            ImplausibleExposureFigures(exposure.implausible_exposures),
            valid_area_figures(judgement.valid_area),
        )
        return evaluate(
            figures,
            capture_flags=conditions.flags | self._calibration_flag,
            missing_sensors=missing,
            missing_probes=temperatures.missing,
            probes_out_of_range=temperatures.out_of_range,
            nominal_bands=judgement.nominal_bands,
            mismatched_bands=judgement.mismatched_bands,
            thresholds=self.settings.thresholds,
            requirements=self.settings.requirements,
        )

    @abstractmethod
    def _product(
        self,
        stages: Stages[CorrectedT, AdjustedT, ImageT],
        judgement: Judgement,
        report: QualityReport,
    ) -> ProductT:
        """The result, with the seconds of all stages."""

    @property
    def _calibration_flag(self) -> Flag:
        return NO_FLAGS if self.rig.is_calibrated else Flag.UNCALIBRATED

    def _missing(self, exposure: ExposureInput) -> tuple[str, ...]:
        return tuple(s.name for s in self.rig.sensors if s.name not in exposure.frames)


def _limit_threads(threads: int) -> None:
    cv2.setNumThreads(threads)
    numba.set_num_threads(max(1, min(threads, int(numba.config.NUMBA_NUM_THREADS))))
