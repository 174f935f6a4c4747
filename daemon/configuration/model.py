"""Keys of `service.toml`: the sections, their types and limits.

Drivers declare the settings of devices. How a file is read is in
`daemon.onboard.preflight.service_file`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    ValidationInfo,
    field_validator,
    model_validator,
)

from daemon import DaemonError
from daemon.configuration.section import ConfigurationSection, FilePath, Several
from daemon.configuration.watch_section import MavlinkCameraSection as MavlinkCameraSection
from daemon.configuration.watch_section import WatchSection as WatchSection
from processing.image.accelerator.devices import DEFAULT_DEVICE, Device
from processing.image.kernels import DEFAULT_INTERPOLATION, Interpolation
from processing.quality.report import Thresholds
from processing.rig.problem_sentences import ProblemList

SIGNING_STATE = ".mavlink-signing.json"
"""Below the missions: the last timestamps of signed MAVLink messages."""

RENAMED_KEYS: Final[Mapping[str, str]] = {
    "exposure.gain_most_db": "gain_max_db",
    "exposure.time_least_us": "exposure_time_min_us",
    "exposure.time_most_us": "exposure_time_max_us",
    "exposure.tdi_most": "tdi_shifts_max",
    "processing.exposures_in_work": "parallel_exposures",
    "watch.certificate": "tls_certificate",
    "watch.key": "tls_key",
    "watch.open": "anonymous_read",
}
"""Former keys, which are refused, and their present names."""


class ConfigurationError(ProblemList, DaemonError, ValueError):
    """An invalid configuration; `problems` holds one sentence per error."""


def local_rig(name: str, folder: Path) -> str:
    """The path of a rig file next to the configuration, or the name of a rig."""
    path = folder / name
    return str(path) if name.endswith(".toml") and path.exists() else name


def _local_rig(name: str, info: ValidationInfo) -> str:
    return local_rig(name, info.context["folder"]) if info.context else name


Vector = Annotated[tuple[float, float, float], Strict(False)]


class _DriverSection(BaseModel):
    """A section with further keys: the settings of its driver."""

    model_config = ConfigDict(
        extra="allow", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    driver: str
    """Name of the driver; its settings are further keys."""


class MissionSection(ConfigurationSection):
    """Storage of missions, and the rig.

    With `mirror`, a folder on another disk, all files are stored on both
    (docs/reference/flight/mirror.md).
    """

    root: FilePath
    """Folder of the missions; a relative path counts from the folder of this file."""
    mirror: FilePath | None = None
    """Folder on another disk for a second copy of every mission."""
    rig: Annotated[str, AfterValidator(_local_rig)]
    """Name of a shipped rig, or path of a rig file."""
    radiometry: FilePath | None = None
    """Folder with the radiometric calibrations of the aperture flown."""
    simulated: bool = False
    """Whether the devices are emulated; every exposure is then flagged `SIMULATED`."""
    end_when_done: bool = False
    """Whether the service ends after the last exposure is processed."""


class PlanSection(ConfigurationSection):
    """The planned flight; navigation data replace its values when they arrive.

    `file` holds the lines (docs/how-to/flight/plan.md). A position farther than `corridor_m` from a
    line (default: a quarter of the image) belongs to no line. `line` names the line without a file.
    `elevation` is a height model in `elevation_crs` (docs/explanation/cameras/dmc.md): it then
    gives the height above the mean terrain of an image.
    """

    line: str = ""
    """Name of the line where no plan is given."""
    file: FilePath | None = None
    """Plan with the lines: GeoJSON, KML or QGroundControl's .plan."""
    corridor_m: float | None = Field(default=None, gt=0)
    """Maximum distance from a line; default: a quarter of the image's width."""
    across_tolerance_m: float | None = Field(default=None, gt=0)
    """Distance from a line that raises an alarm; default: what the overlap tolerance permits."""
    height_tolerance_m: float | None = Field(default=None, gt=0)
    """Deviation from the planned height that raises an alarm; default: from overlap and GSD."""
    ground_height_m: float = 0.0
    """Mean height of the ground above the ellipsoid."""
    height_above_ground_m: float = Field(default=1000.0, gt=0)
    """Planned height of flight."""
    ground_speed_mps: float = Field(default=60.0, gt=0)
    """Planned speed."""
    elevation: FilePath | None = None
    """Height model of the ground: GeoTIFF or ESRI ASCII grid."""
    elevation_crs: str = ""
    """Coordinate reference system of the height model, such as EPSG:25833+7837."""

    @model_validator(mode="after")
    def _requires_elevation_crs(self) -> PlanSection:
        if self.elevation is not None and not self.elevation_crs:
            raise ValueError(
                "elevation needs elevation_crs, the model's system, such as EPSG:25833+7837"
            )
        return self


class MountSection(ConfigurationSection):
    """Mounting of the camera relative to the navigation receiver.

    Conventions: docs/how-to/processing/orientation.md.

    `antenna_m` is the point whose position the receiver reports, in the body frame of the rig;
    `boresight_deg` (roll, pitch, heading) rotates the rig's body axes into the inertial unit's.
    `time_offset_ms` is added to exposure times before the trajectory is interpolated.
    """

    antenna_m: Vector = (0.0, 0.0, 0.0)
    """Antenna in the body frame of the rig: forward, right, down."""
    boresight_deg: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch and heading from the rig's body axes to those of the inertial unit."""
    time_offset_ms: float = 0.0
    """Added to exposure times before the trajectory is interpolated."""


class SerialsSection(ConfigurationSection):
    """Serial numbers that no bus reports, from the labels of lenses (by cone) and probes.

    They are compared with those of the calibration before a flight
    (docs/reference/flight/arming.md).
    """

    lens: dict[str, str] = Field(default_factory=dict)
    """Serial number of each lens by the name of its cone."""
    probe: dict[str, str] = Field(default_factory=dict)
    """Serial number of each probe by its name."""

    @property
    def parts(self) -> dict[str, str]:
        """As `Rig.serials` names them."""
        named = {f"lens {name}": serial for name, serial in self.lens.items()}
        return named | {f"probe {name}": serial for name, serial in self.probe.items()}


class TriggerSection(_DriverSection):
    """Exposure times and the trigger. Further keys are settings of the trigger's driver."""

    mode: Literal["interval", "distance", "plan"] = "interval"
    """What causes an exposure: time, distance flown, or the places of the plan."""
    interval_s: float = Field(default=2.0, gt=0)
    """Time between two exposures in mode `interval`."""
    distance_m: float | None = Field(default=None, gt=0)
    """Distance between two exposures in mode `distance`."""
    count: int | None = Field(default=None, gt=0)
    """Number of exposures; without it the line has no end."""
    start: Literal["immediate", "on command"] = "immediate"
    """When the line begins: as soon as the service is ready, or on a command."""

    @field_validator("start", mode="before")
    @classmethod
    def _refuse_old_start(cls, given: Any) -> Any:
        if given == "at once":
            raise ValueError("'at once' is now named 'immediate'; rename it")
        return given

    @model_validator(mode="after")
    def _requires_distance(self) -> TriggerSection:
        if self.mode == "distance" and self.distance_m is None:
            raise ValueError(
                "mode 'distance' needs distance_m, the distance between two exposures in m"
            )
        return self


class DeviceSection(_DriverSection):
    """One device: its driver, and the settings of that driver."""

    @property
    def settings(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class HeadDeviceSection(DeviceSection):
    """The head that carries a sensor of the rig."""

    sensor: str
    """Name of the sensor in the rig file."""


class NamedDeviceSection(DeviceSection):
    """A thermometer, a navigator or a pulse per second."""

    name: str
    """Name of the device in records and messages."""


class ExposureSection(ConfigurationSection):
    """Control of the exposure settings of the heads, with limits (docs/how-to/flight/exposure.md).

    `target` is the desired 99th percentile of the pixels, as a fraction of full scale. With `lock`
    "line" the settings do not change on a line after they meet the target.
    """

    control: Literal["manual", "automatic"] = "manual"
    """Whether the service changes the settings of the heads in flight."""
    lock: Literal["line", "never"] = "line"
    """Whether settings stay fixed on a line after they met the target."""
    target: float = Field(default=0.6, ge=0.1, le=0.95)
    """Desired 99th percentile of the pixels as a fraction of full scale."""
    smear_px: float = Field(default=0.5, gt=0, le=10)
    """Permitted motion blur that remains after TDI."""
    gain_max_db: float = Field(default=12.0, ge=0, le=48)
    """Highest gain."""
    exposure_time_min_us: float = Field(default=100.0, gt=0)
    """Shortest exposure time."""
    exposure_time_max_us: float = Field(default=20_000.0, gt=0)
    """Longest exposure time."""
    tdi_shifts_max: int = Field(default=32, ge=0, le=1000)
    """Highest number of TDI shifts."""


class ProcessingSection(ConfigurationSection):
    """Processing of exposures, and the thresholds of their verdicts.

    `thresholds` are those of `processing.quality.report.Thresholds` that are not the defaults.
    """

    method: Literal["free", "fixed"] = "free"
    """Stitching by free image mosaicking, or by the fixed calibration."""
    interpolation: Interpolation = DEFAULT_INTERPOLATION
    """Kernel of the one resampling from raw pixels."""
    device: Device = DEFAULT_DEVICE
    """Device that corrects and resamples frames; `cuda-reference` computes the pixels of `cuda` on
    the processor."""
    baselines: bool = False
    """Whether results of the fixed method are written for comparison."""
    geometry: bool = True
    """Whether the geometry of each image is written to `geometry.npz`."""
    threads: int = Field(default=2, ge=1, le=256)
    """Threads of the pipeline."""
    parallel_exposures: int = Field(default=2, ge=1, le=16)
    """Exposures processed at the same time."""
    thresholds: dict[str, float] = Field(
        default_factory=dict,
        json_schema_extra={"propertyNames": {"enum": [one.name for one in fields(Thresholds)]}},
    )
    """Thresholds of the flags that differ from their defaults, by name."""

    @field_validator("thresholds")
    @classmethod
    def _check_thresholds(cls, given: dict[str, float]) -> dict[str, float]:
        if "burnt_overlap_fraction" in given:
            raise ValueError(
                "burnt_overlap_fraction is now named saturated_overlap_fraction; rename it"
            )
        unknown = sorted(given.keys() - {field.name for field in fields(Thresholds)})
        if unknown:
            raise ValueError(
                f"{', '.join(unknown)}: no such threshold; "
                "docs/reference/formats.md lists them by flag"
            )
        return given


class TriangulationSection(ConfigurationSection):
    """Triangulation while flying (docs/how-to/flight/live-triangulation.md).

    Its process has the lowest priority. Standard deviations hold where the receiver states none.
    """

    enabled: bool = False
    """Whether exposures are triangulated in flight."""
    position_sigma_m: float = Field(default=0.05, gt=0)
    """Standard deviation of each horizontal coordinate of the antenna."""
    height_sigma_m: float = Field(default=0.08, gt=0)
    """Standard deviation of its height."""
    attitude_sigma_mdeg: Vector = (5.0, 5.0, 8.0)
    """Standard deviations of roll, pitch and heading."""
    boresight_sigma_mdeg: float = Field(default=6.0, gt=0)
    """Standard deviation of each angle of the calibrated boresight."""
    lever_arm_sigma_m: float = Field(default=0.02, gt=0)
    """Standard deviation of each coordinate of the lever arm."""
    exposures_max: int = Field(default=600, ge=20, le=2000)
    """Latest exposures that are adjusted as one block."""
    control_points: FilePath | None = None
    """Table of control and check points with which the block is compared; they take no part."""
    memory_max_mb: int = Field(default=1500, ge=500)
    """Private memory of the process."""
    landing_timeout_s: float = Field(default=10.0, gt=0, le=600)
    """Time for the last adjustment and the files after landing."""
    orthomosaic: bool = True
    """Whether a preliminary orthomosaic grows on the map."""
    orthomosaic_gsd_m: float | None = Field(default=None, gt=0)
    """Its ground sampling distance, as near as a level of the web map comes (default: 8 times that
    of the images, or more for images wider than 4096 pixels)."""


class LimitsSection(ConfigurationSection):
    """Time limits, and the number of exposures in memory."""

    frame_timeout_s: float = Field(default=8.0, gt=0)
    """Time after a trigger until a frame counts as missing."""
    mark_timeout_s: float = Field(default=3.0, gt=0)
    """Time after a trigger until an event mark counts as missing."""
    ready_timeout_s: float = Field(default=60.0, gt=0)
    """Time that the service waits for its devices at the start."""
    temperature_stale_s: float = Field(default=10.0, gt=0)
    """Age from which a temperature is too old for arming."""
    navigation_stale_s: float = Field(default=5.0, gt=0)
    """Age from which a position is too old for arming."""
    exposures_in_memory: int = Field(default=3, ge=2, le=16)
    """Exposures whose frames have a place in memory."""
    disk_reserve_bytes: int = Field(default=500_000_000, ge=0)
    """Space on a disk that exposures leave free."""
    disk_warn_exposures: int = Field(default=100, ge=0)
    """Number of exposures that still fit below which low space is reported."""
    mirror_timeout_s: float = Field(default=2.0, gt=0)
    """Time after which a disk that does not answer is dropped."""
    power_fail_s: float = Field(default=5.0, gt=0, le=60)
    """Time in which open exposures are stored and sealed after a power failure."""


class NetworkSection(ConfigurationSection):
    """Links between heads and this computer (docs/how-to/flight/link-budget.md).

    The rate of an interface is read from the kernel. `link_mbps` replaces it where the interface
    reports none, or where a slower link lies between the switch and this computer.
    """

    link_mbps: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    """Rate of the slowest link between heads and this computer by interface, Mbit/s."""
    head_link_mbps: float = Field(default=1000.0, gt=0)
    """Rate of the link between a head and the switch, Mbit/s."""
    switch_buffer_bytes: int = Field(default=131_072, ge=2048)
    """Bytes that the switch can queue for one link."""
    is_paced: bool = True
    """Whether heads that share a link are paced."""


class LandingSection(ConfigurationSection):
    """What the page may do after landing (docs/how-to/flight/watching.md)."""

    copy_to: Several[FilePath] = Field(default=(), max_length=8)
    """Folders of other disks that a mission may be copied into from the page."""


class Configuration(ConfigurationSection):
    """The complete file."""

    mission: MissionSection
    plan: PlanSection = PlanSection()
    mount: MountSection = MountSection()
    serials: SerialsSection = SerialsSection()
    trigger: TriggerSection
    head: Several[HeadDeviceSection] = Field(min_length=1)
    thermometer: Several[NamedDeviceSection] = ()
    navigator: Several[NamedDeviceSection] = ()
    pps: Several[NamedDeviceSection] = Field(default=(), max_length=1)
    exposure: ExposureSection = ExposureSection()
    processing: ProcessingSection = ProcessingSection()
    triangulation: TriangulationSection = TriangulationSection()
    limits: LimitsSection = LimitsSection()
    network: NetworkSection = NetworkSection()
    landing: LandingSection = LandingSection()
    watch: WatchSection | None = None

    @property
    def drivers(self) -> tuple[tuple[str, str], ...]:
        """Kind and driver of every device."""
        devices: dict[str, Sequence[DeviceSection]] = {
            "head": self.head,
            "thermometer": self.thermometer,
            "navigator": self.navigator,
            "pps": self.pps,
        }
        listed = [(kind, one.driver) for kind, many in devices.items() for one in many]
        return (*listed, ("trigger", self.trigger.driver))

    @model_validator(mode="after")
    def _requires_plan(self) -> Configuration:
        if self.trigger.mode == "plan" and self.plan.file is None:
            raise ValueError("trigger.mode is 'plan' and there is no plan.file; give the plan")
        return self
