"""The live triangulation of one mission: exposures in, orientations, findings and files out.

Used in flight and to replay a mission. It reads records and Level-2, and writes only below
`export/triangulation/live`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.configuration.model import MountSection, PlanSection
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store.level0 import read_tiff
from daemon.onboard.triangulation.control_points import (
    ControlPointsError,
    ImageMeasurements,
    PointResidual,
    SurveyedPoints,
    control_findings,
    read_measurements,
    read_surveyed,
    residuals_of,
)
from daemon.onboard.triangulation.drifts import Drift, live_drifts
from daemon.onboard.triangulation.exposure_patterns import exposure_patterns
from daemon.onboard.triangulation.findings import (
    CUT_OFF,
    LOST,
    NOT_PROCESSED,
    NOT_SEALED,
    TriangulationFinding,
    findings_of,
    live_ties,
)
from daemon.onboard.triangulation.flown_lines import FlownLines
from daemon.onboard.triangulation.flown_plan import missing_at_ends
from daemon.onboard.triangulation.ground_coverage import GroundCoverage, coverage_of
from daemon.onboard.triangulation.height_model_check import (
    HeightModelCheck,
    check_heights,
    read_relief,
)
from daemon.onboard.triangulation.measured_images import measured_image, oriented
from daemon.orientation.exterior_orientation import (
    NavigationSource,
    mount_of,
    sealed_exposure,
)
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.navigation_sigmas import NavigationSigmas
from daemon.planning.model import PlannedLine
from daemon.planning.plan_readers import read_plan
from daemon.planning.relief import TerrainRelief
from processing import ProcessingError
from processing.matching.patch_tracks import usable
from processing.pipelines.live_triangulation import (
    LiveOrientation,
    LiveSettings,
    LiveTriangulation,
)
from processing.rig import Rig, load_rig

FOLDER: Final = "triangulation/live"
"""Below a mission's `export`."""
_NO_IMAGE: Final = "no stitched image"


class LiveTriangulationError(DaemonError, ValueError):
    """A mission that cannot be triangulated live; the message states why."""


@dataclass(frozen=True)
class ExposureTriangulated:
    """What one exposure became: its orientation, or why it has none."""

    number: int
    orientation: LiveOrientation | None
    reason: str
    seconds: float


@dataclass(frozen=True)
class GroundAccuracy:
    """Expected standard deviations of tie points in m: median and 95th percentile."""

    points: int
    plan_m: float
    height_m: float
    plan_95_m: float
    height_95_m: float

    def as_json(self) -> dict[str, Any]:
        return vars(self)


@dataclass
class MissionTriangulation:
    """The block of a mission.

    Args:
        mission: its folder.
        settings: of the triangulation; its prior of the mounting is that of `sigmas`.
        sigmas: of navigation and mounting.
        trajectory: in place of the navigation in the records.
        control: table of control and check points, with which the block is compared.
        measured: table of their image coordinates.
        on_image: receives each image that was added with its orientation.

    Raises:
        LiveTriangulationError: the rig has no stitched image.
        ConfigurationError, RigError: as their modules say.
    """

    mission: Mission
    settings: LiveSettings = field(default_factory=LiveSettings)
    sigmas: NavigationSigmas = field(default_factory=NavigationSigmas)
    trajectory: NavigationSource | None = None
    control: Path | None = None
    measured: Path | None = None
    on_image: Callable[[LiveOrientation, NDArray[np.uint16]], None] | None = None

    def __post_init__(self) -> None:
        self.settings = replace(self.settings, prior=self.sigmas.prior)
        self.rig: Rig = load_rig(self.mission.rig_path)
        if self.rig.virtual_image is None:
            raise LiveTriangulationError(
                f"rig {self.rig.name} stitches no PAN image, so no block grows in flight; run "
                "`syntopic triangulate MISSION --head HEAD` after landing"
            )
        self.mount: MountSection
        self.plan: PlanSection
        self.mount, self.plan = mount_of(self.mission)
        self.frame: LocalFrame | None = None
        self.live: LiveTriangulation | None = None
        self.skipped: dict[int, str] = {}
        self.drifts: tuple[Drift, ...] = ()
        self.findings: tuple[TriangulationFinding, ...] = ()
        self.heights: HeightModelCheck | None
        self.coverage: GroundCoverage | None = None
        self.residuals: tuple[PointResidual, ...] = ()
        self.block_seconds = 0.0
        self.block_count = 0
        self.has_landed = False
        self.is_simulated = False
        self.relief: TerrainRelief | None
        self.relief, self.heights = read_relief(self.plan)
        self._control_problem = ""
        self._surveyed, self._measurements = self._read_control()
        self._planned = self._read_plan()
        self._planned_lines = tuple(line.id for line in self._planned)
        self._lines = FlownLines(self._planned_lines)

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.mission.export_dir / FOLDER

    def has(self, number: int) -> bool:
        """True if the exposure is in the block."""
        return self.live is not None and any(one.number == number for one in self.live.images)

    def add(self, exposure: Exposure) -> ExposureTriangulated:
        """Add an exposure that has its products; a new line first adjusts the block.

        One that came before is ignored: it keeps its orientation.
        """
        begun = time.perf_counter()
        number = exposure.number
        self.is_simulated |= exposure.simulated
        if self.has(number):
            return ExposureTriangulated(number, None, "came before", 0.0)
        if exposure.state == "lost" or not exposure.frames:
            return self._skip(number, LOST, begun)
        eo = oriented(exposure, self.rig, self.mount, self.trajectory)
        if isinstance(eo, str):
            return self._skip(number, eo, begun)
        image = self.rig.virtual_image
        assert image is not None
        try:
            pixels = read_tiff(
                self.mission.level2(number) / "pan.tif",
                width_px=image.width_px,
                height_px=image.height_px,
            )
        except FileNotFoundError:
            return self._skip(number, _NO_IMAGE, begun)
        except (OSError, ValueError) as error:
            return self._skip(number, f"its image cannot be read ({error})", begun)
        if self.frame is None or self.live is None:
            self.frame = LocalFrame(eo.latitude_deg, eo.longitude_deg)
            ground = self.frame.from_geodetic(
                np.array(eo.latitude_deg),
                np.array(eo.longitude_deg),
                np.array(self.plan.ground_height_m),
            )
            self.live = LiveTriangulation(image, float(ground[2]), self.settings)
        patterns = exposure_patterns(self.mission, number)
        measured = measured_image(exposure, eo, self.frame, self.sigmas, patterns)
        above_m = max(float(measured.position_m[2]) - self.live.block.ground_m, 0.0)
        width_m = image.width_px * image.pitch_mm / image.f_mm * above_m
        measured = replace(measured, line=self._lines.name(measured, width_m))
        if self.live.images and self.live.images[-1].line != measured.line:
            self.adjust_block()
        try:
            orientation = self.live.add(measured, usable(pixels))
        except ProcessingError as error:
            return self._skip(number, f"it cannot be tied ({error})", begun)
        self.skipped.pop(number, None)
        if self.on_image is not None:
            self.on_image(orientation, pixels)
        return ExposureTriangulated(number, orientation, "", time.perf_counter() - begun)

    def adjust_block(self) -> None:
        """Adjust the whole block and look for what is wrong."""
        if self.live is None:
            self._find()
            return
        begun = time.perf_counter()
        if self.has_landed:
            self.live.land()
        else:
            self.live.adjust_block()
        self.block_seconds = time.perf_counter() - begun
        self.block_count += 1
        self._find()

    def land(self) -> None:
        """The last adjustment of the block, with what was planned and not flown, and with every
        exposure of the mission that is not in it."""
        self.has_landed = True
        self.note_absent()
        self.adjust_block()

    def note_absent(self) -> None:
        """Note every exposure of the mission that was not added, with the reason."""
        added = {one.number for one in self.live.images} if self.live is not None else set()
        for number in self.mission.numbers():
            if number not in added and number not in self.skipped:
                self.skipped[number] = self._why_absent(number)

    def _why_absent(self, number: int) -> str:
        try:
            exposure = sealed_exposure(self.mission, number)
        except (OSError, DaemonError, ValueError) as error:
            return f"its record cannot be read ({error})"
        if exposure is None:
            return NOT_SEALED
        if exposure.state == "lost" or not exposure.frames:
            return LOST
        if not (self.mission.level2(number) / "pan.tif").exists():
            return NOT_PROCESSED
        return CUT_OFF

    def accuracy(self) -> GroundAccuracy | None:
        """Expected accuracy on the ground without control; None before the block is adjusted."""
        if self.live is None:
            return None
        _, _, sigma = self.live.tied_points()
        if not len(sigma):
            return None
        plan = np.sqrt(np.mean(np.square(sigma[:, :2]), axis=1))
        return GroundAccuracy(
            len(sigma),
            float(np.median(plan)),
            float(np.median(sigma[:, 2])),
            float(np.percentile(plan, 95)),
            float(np.percentile(sigma[:, 2], 95)),
        )

    def _skip(self, number: int, reason: str, begun: float) -> ExposureTriangulated:
        self.skipped[number] = reason
        return ExposureTriangulated(number, None, reason, time.perf_counter() - begun)

    def _find(self) -> None:
        if self.live is None:
            image = self.rig.virtual_image
            assert image is not None
            empty = LiveTriangulation(image, 0.0, self.settings)
            self.findings = findings_of(
                live_ties(empty), (), skipped=self.skipped, planned_lines=self._planned_lines,
                heights=self.heights, has_landed=self.has_landed,
            )  # fmt: skip
            return
        self.drifts = live_drifts(self.live)
        self.heights = self._check_heights()
        self.coverage = coverage_of(self.live)
        if self._surveyed is not None and self.frame is not None:
            self.residuals = residuals_of(self.live, self.frame, self._surveyed, self._measurements)
        found = findings_of(
            live_ties(self.live),
            self.drifts,
            skipped=self.skipped,
            planned_lines=self._planned_lines,
            missing_at_ends=self._missing_at_ends(),
            heights=self.heights,
            has_landed=self.has_landed,
        )
        self.findings = (*found, *control_findings(self.residuals, problem=self._control_problem))

    def _read_control(self) -> tuple[SurveyedPoints | None, ImageMeasurements | None]:
        """Points with which the block is compared; what is wrong with a table is a finding."""
        try:
            if self.control is None:
                return None, None
            surveyed = read_surveyed(self.control)
            if self.measured is None:
                return surveyed, None
            return surveyed, read_measurements(self.measured, surveyed.names)
        except ControlPointsError as error:
            self._control_problem = str(error)
            return None, None

    def _read_plan(self) -> tuple[PlannedLine, ...]:
        if self.mission.plan_path is None:
            return ()
        try:
            return read_plan(self.mission.plan_path).lines
        except (OSError, DaemonError):
            return ()

    def _missing_at_ends(self) -> dict[str, int]:
        """Planned exposures at the ends of lines that have no image."""
        if not self._planned or self.live is None or self.frame is None or not self.live.images:
            return {}
        images = self.live.images
        places = self.frame.to_geodetic(np.array([one.position_m for one in images]))
        return missing_at_ends(self._planned, [one.line for one in images], places[:, :2])

    def _check_heights(self) -> HeightModelCheck | None:
        """Tie points against the height model."""
        if self.relief is None or self.live is None or self.frame is None:
            return self.heights
        _, xyz, sigma = self.live.tied_points()
        return check_heights(self.relief, self.frame, xyz, sigma) or self.heights
