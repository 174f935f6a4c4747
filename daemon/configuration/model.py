"""Keys of `service.toml`: the sections, their types and limits.

Drivers declare the settings of devices. How a file is read is in
`daemon.configuration.service_file`.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

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


def _in_folder(path: Path, info: ValidationInfo) -> Path:
    """The path relative to the folder of the file, if that is in the context of the validation."""
    return info.context["folder"] / path if info.context else path


def local_rig(name: str, folder: Path) -> str:
    """The path of a rig file next to the configuration, or the name of a rig."""
    path = folder / name
    return str(path) if name.endswith(".toml") and path.exists() else name


def _local_rig(name: str, info: ValidationInfo) -> str:
    return local_rig(name, info.context["folder"]) if info.context else name


Item = TypeVar("Item")
Several = Annotated[tuple[Item, ...], Strict(False)]
Vector = Annotated[tuple[float, float, float], Strict(False)]
FilePath = Annotated[Path, Strict(False), AfterValidator(_in_folder)]


class _ConfigurationSection(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class _DriverSection(BaseModel):
    """A section with further keys: the settings of its driver."""

    model_config = ConfigDict(
        extra="allow", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    driver: str
    """Name of the driver; its settings are further keys."""


class MissionSection(_ConfigurationSection):
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


class PlanSection(_ConfigurationSection):
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


class MountSection(_ConfigurationSection):
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


class SerialsSection(_ConfigurationSection):
    """Serial numbers that no bus reports, from the labels of lenses (by cone) and probes.

    They are compared with those of the calibration before a flight
    (docs/reference/flight/arming.md).
    """

    lens: dict[str, str] = {}
    """Serial number of each lens by the name of its cone."""
    probe: dict[str, str] = {}
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


class ExposureSection(_ConfigurationSection):
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


class ProcessingSection(_ConfigurationSection):
    """Processing of exposures, and the thresholds of their verdicts.

    `thresholds` are those of `processing.quality.report.Thresholds` that are not the defaults.
    """

    method: Literal["free", "fixed"] = "free"
    """Stitching by free image mosaicking, or by the fixed calibration."""
    interpolation: Interpolation = DEFAULT_INTERPOLATION
    """Kernel of the one resampling from raw pixels."""
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


class MavlinkCameraSection(_ConfigurationSection):
    """The rig as one camera of a vehicle (docs/how-to/flight/mavlink-camera.md).

    `connect` is "udpout:HOST:PORT", the address of a ground station or autopilot, or
    "udpin:HOST:PORT". `commands` from others are executed when "signed" (with `signing_key`, a file
    of 64 hexadecimal digits), from "any", or from "none". `signing_state` is the file for
    the last timestamps of signed messages (default: in the folder of missions).
    """

    connect: str = "udpout:127.0.0.1:14550"
    """Address: `udpout:HOST:PORT` or `udpin:HOST:PORT`."""
    system_id: int = Field(default=1, ge=1, le=255)
    """MAVLink system, that of the vehicle."""
    component_id: int = Field(default=100, ge=100, le=105)
    """MAVLink component."""
    commands: Literal["signed", "any", "none"] = "none"
    """Whose commands are executed."""
    signing_key: FilePath | None = None
    """File with the signing key of 64 hexadecimal digits."""
    signing_state: FilePath | None = None
    """File of the last timestamps of signed messages; default: below the missions."""
    feedback: bool = False
    """Whether `CAMERA_FEEDBACK` is sent for autopilots."""

    @model_validator(mode="after")
    def _check_connection(self) -> MavlinkCameraSection:
        scheme, _, rest = self.connect.partition(":")
        host, _, port = rest.rpartition(":")
        is_valid_port = port.isdecimal() and 0 < int(port) < 65536
        if scheme not in ("udpin", "udpout") or not host or not is_valid_port:
            raise ValueError(
                f"connect is {self.connect!r}; write udpout:HOST:PORT or udpin:HOST:PORT"
            )
        if self.commands == "signed" and self.signing_key is None:
            raise ValueError("commands are 'signed' and signing_key is missing; give its file")
        return self


class WatchSection(_ConfigurationSection):
    """Access for monitoring and commands (docs/how-to/flight/watching.md).

    Commands over the network require a token. At the Unix socket `control` members of
    `control_group` are operators, and members of `control_administrator_group` administrators.
    """

    host: str = "127.0.0.1"
    """Address on which page and API listen."""
    port: int = Field(default=8470, ge=0, le=65535)
    """TCP port of page and API; 0 takes any free port."""
    anonymous_read: bool = True
    """Whether reading requires no token. Commands always require one."""
    tokens: FilePath | None = None
    """File with the hashes of the tokens; without it there are no commands over the network."""
    tls_certificate: FilePath | None = None
    """Certificate of the server, PEM."""
    tls_key: FilePath | None = None
    """Private key of the certificate, PEM."""
    announce: bool = True
    """Whether the service is announced by mDNS."""
    udp: Several[str] = Field(default=(), max_length=8)
    """Receivers of telemetry datagrams, `HOST:PORT` each."""
    udp_bytes_per_s: float = Field(default=4000.0, ge=1000)
    """Highest rate of datagrams to each receiver."""
    mavlink: MavlinkCameraSection | None = None
    control: FilePath | None = None
    """Path of the Unix socket for commands on this computer."""
    control_group: str | None = None
    """Group whose members are operators; default: the group of the service."""
    control_administrator_group: str | None = None
    """Group whose members are administrators, in addition to root."""
    hosts: Several[str] = Field(default=(), max_length=16)
    """Names under which the page is served, in addition to the computer's own."""
    proxies: Several[str] = Field(default=(), max_length=8)
    """IP addresses of reverse proxies whose forwarding headers count."""

    @property
    def udp_addresses(self) -> dict[str, tuple[str, int]]:
        """Addresses of datagrams by their text in the configuration."""
        return {text: (text.rpartition(":")[0], int(text.rpartition(":")[2])) for text in self.udp}

    @model_validator(mode="after")
    def _check_udp(self) -> WatchSection:
        for text in self.udp:
            host, _, port = text.rpartition(":")
            if not host or not port.isdecimal() or not 0 < int(port) < 65536:
                raise ValueError(f"udp has {text!r}; write HOST:PORT")
        return self

    @field_validator("hosts")
    @classmethod
    def _check_hosts(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.\-]{0,251}[A-Za-z0-9])?", name):
                raise ValueError(f"hosts has {name!r}; write a host name without scheme and port")
        return names

    @field_validator("proxies")
    @classmethod
    def _check_proxies(cls, addresses: tuple[str, ...]) -> tuple[str, ...]:
        for address in addresses:
            try:
                ipaddress.ip_address(address)
            except ValueError:
                raise ValueError(f"proxies has {address!r}; write an IP address") from None
        return addresses

    @model_validator(mode="after")
    def _check_tls(self) -> WatchSection:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key belong together; give both or none")
        is_remote = not (self.host.startswith("127.") or self.host in ("::1", "localhost"))
        if is_remote and self.tokens is not None and self.tls_certificate is None:
            raise ValueError(
                f"host {self.host} is not on this machine, and tokens would be sent without "
                "encryption; give tls_certificate and tls_key, or no tokens (no commands)"
            )
        return self


class LimitsSection(_ConfigurationSection):
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


class NetworkSection(_ConfigurationSection):
    """Links between heads and this computer (docs/how-to/flight/link-budget.md).

    The rate of an interface is read from the kernel. `link_mbps` replaces it where the interface
    reports none, or where a slower link lies between the switch and this computer.
    """

    link_mbps: dict[str, Annotated[float, Field(gt=0)]] = {}
    """Rate of the slowest link between heads and this computer by interface, Mbit/s."""
    head_link_mbps: float = Field(default=1000.0, gt=0)
    """Rate of the link between a head and the switch, Mbit/s."""
    switch_buffer_bytes: int = Field(default=131_072, ge=2048)
    """Bytes that the switch can queue for one link."""
    is_paced: bool = True
    """Whether heads that share a link are paced."""


class Configuration(_ConfigurationSection):
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
    limits: LimitsSection = LimitsSection()
    network: NetworkSection = NetworkSection()
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
