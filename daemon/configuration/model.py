"""Configuration of the service: one TOML file. All errors of a file are reported together.

Drivers define the settings of devices; this module validates them through
`drivers.base.registry`.
"""

from __future__ import annotations

import ipaddress
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    field_validator,
    model_validator,
)

from daemon.configuration.problems import (
    device_problems,
    mirror_problems,
    nested_value,
    rig_problems,
)
from daemon.planning.plan_readers import PlanError, read_plan
from processing.image.kernels import DEFAULT_INTERPOLATION, Interpolation
from processing.quality.report import Thresholds
from processing.rig import Rig, RigError, find_rig
from processing.rig.toml_text import TomlError, parse_toml

CONFIGURATION_MAX_BYTES = 1_000_000
_WATCH_FILES = ("tokens", "tls_certificate", "tls_key", "control")
"""Keys of `[watch]` with paths relative to the folder of the file."""

SIGNING_STATE = ".mavlink-signing.json"
"""Below the missions: the last timestamps of signed MAVLink messages."""


class ConfigurationError(ValueError):
    """An invalid configuration; `problems` holds one sentence per error."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))


def _refuse_old_keys(given: Any, renamed: Mapping[str, str]) -> Any:
    """Raise a `ValueError` naming the new key when a section holds an old one."""
    for old, new in renamed.items():
        if isinstance(given, dict) and old in given:
            raise ValueError(f"{old} is now named {new}; rename it")
    return given


class _ConfigurationSection(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MissionSection(_ConfigurationSection):
    """Storage of missions, and the rig.

    With `mirror`, a folder on another disk, all files are stored on both (docs/mirror.md).
    """

    root: Path
    mirror: Path | None = None
    rig: str
    radiometry: Path | None = None
    simulated: bool = False
    end_when_done: bool = False


class PlanSection(_ConfigurationSection):
    """The planned flight; navigation data replace its values when they arrive.

    `file` holds the lines (docs/plan.md). A position farther than `corridor_m` from a line (default:
    a quarter of the image) belongs to no line. `line` names the line without a file.
    `elevation` is a height model in `elevation_crs` (docs/dmc.md): it then gives the height
    above the mean terrain of an image.
    """

    line: str = ""
    file: Path | None = None
    corridor_m: float | None = Field(default=None, gt=0)
    ground_height_m: float = 0.0
    height_above_ground_m: float = Field(default=1000.0, gt=0)
    ground_speed_mps: float = Field(default=60.0, gt=0)
    elevation: Path | None = None
    elevation_crs: str = ""

    @model_validator(mode="after")
    def _requires_elevation_crs(self) -> PlanSection:
        if self.elevation is not None and not self.elevation_crs:
            raise ValueError(
                "elevation needs elevation_crs, the model's system, such as EPSG:25833+7837"
            )
        return self


class MountSection(_ConfigurationSection):
    """Mounting of the camera relative to the navigation receiver (docs/orientation.md).

    `antenna_m` is the point whose position the receiver reports, in the body frame of the rig;
    `boresight_deg` (roll, pitch, heading) rotates the rig's body axes into the inertial unit's.
    `time_offset_ms` is added to exposure times before the trajectory is interpolated.
    """

    antenna_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    boresight_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset_ms: float = 0.0


class SerialsSection(_ConfigurationSection):
    """Serial numbers that no bus reports, from the labels of lenses (by cone) and probes.

    They are compared with those of the calibration before a flight (docs/arming.md).
    """

    lens: Mapping[str, str] = {}
    probe: Mapping[str, str] = {}

    @property
    def parts(self) -> dict[str, str]:
        """As `Rig.serials` names them."""
        named = {f"lens {name}": serial for name, serial in self.lens.items()}
        return named | {f"probe {name}": serial for name, serial in self.probe.items()}


class TriggerSection(BaseModel):
    """Exposure times and the trigger. Further keys are settings of the trigger's driver."""

    model_config = ConfigDict(extra="allow", frozen=True)

    driver: str
    mode: Literal["interval", "distance", "plan"] = "interval"
    interval_s: float = Field(default=2.0, gt=0)
    distance_m: float | None = Field(default=None, gt=0)
    count: int | None = Field(default=None, gt=0)
    start: Literal["immediate", "on command"] = "immediate"

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


class DeviceSection(BaseModel):
    """One device: its driver, and the settings of that driver."""

    model_config = ConfigDict(extra="allow", frozen=True)

    driver: str

    @property
    def settings(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class HeadDeviceSection(DeviceSection):
    """The head that carries a sensor of the rig."""

    sensor: str


class NamedDeviceSection(DeviceSection):
    """A thermometer, a navigator or a pulse per second."""

    name: str


class ExposureSection(_ConfigurationSection):
    """Control of the exposure settings of the heads, with limits (docs/exposure.md).

    `target` is the desired 99th percentile of the pixels, as a fraction of full scale. With `lock`
    "line" the settings do not change on a line after they meet the target.
    """

    control: Literal["manual", "automatic"] = "manual"
    lock: Literal["line", "never"] = "line"
    target: float = Field(default=0.6, ge=0.1, le=0.95)
    smear_px: float = Field(default=0.5, gt=0, le=10)
    gain_max_db: float = Field(default=12.0, ge=0, le=48)
    exposure_time_min_us: float = Field(default=100.0, gt=0)
    exposure_time_max_us: float = Field(default=20_000.0, gt=0)
    tdi_shifts_max: int = Field(default=32, ge=0, le=1000)

    @model_validator(mode="before")
    @classmethod
    def _refuse_old_keys(cls, given: Any) -> Any:
        return _refuse_old_keys(
            given,
            {
                "gain_most_db": "gain_max_db",
                "time_least_us": "exposure_time_min_us",
                "time_most_us": "exposure_time_max_us",
                "tdi_most": "tdi_shifts_max",
            },
        )


class ProcessingSection(_ConfigurationSection):
    """Processing of exposures, and the thresholds of their verdicts.

    `thresholds` are those of `processing.quality.report.Thresholds` that are not the defaults.
    """

    method: Literal["free", "fixed"] = "free"
    interpolation: Interpolation = DEFAULT_INTERPOLATION
    baselines: bool = False
    geometry: bool = True
    threads: int = Field(default=2, ge=1, le=256)
    parallel_exposures: int = Field(default=2, ge=1, le=16)
    thresholds: dict[str, FiniteFloat] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _refuse_old_keys(cls, given: Any) -> Any:
        return _refuse_old_keys(given, {"exposures_in_work": "parallel_exposures"})

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
                f"{', '.join(unknown)}: no such threshold; docs/formats.md lists them by flag"
            )
        return given


class MavlinkCameraSection(_ConfigurationSection):
    """The rig as one camera of a vehicle (docs/mavlink-camera.md).

    `connect` is "udpout:HOST:PORT", the address of a ground station or autopilot, or
    "udpin:HOST:PORT". `commands` from others are executed when "signed" (with `signing_key`, a file
    of 64 hexadecimal digits), from "any", or from "none". `signing_state` is the file for
    the last timestamps of signed messages (default: in the folder of missions).
    """

    connect: str = "udpout:127.0.0.1:14550"
    system_id: int = Field(default=1, ge=1, le=255)
    component_id: int = Field(default=100, ge=100, le=105)
    commands: Literal["signed", "any", "none"] = "none"
    signing_key: Path | None = None
    signing_state: Path | None = None
    feedback: bool = False

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
    """Access for monitoring and commands (docs/watching.md). Commands over the network require a
    token. At the Unix socket `control` members of `control_group` are operators, and members of
    `control_administrator_group` administrators.
    """

    host: str = "127.0.0.1"
    port: int = Field(default=8470, ge=0, le=65535)
    anonymous_read: bool = True
    tokens: Path | None = None
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    announce: bool = True
    udp: tuple[str, ...] = Field(default=(), max_length=8)
    udp_bytes_per_s: float = Field(default=4000.0, ge=1000)
    mavlink: MavlinkCameraSection | None = None
    control: Path | None = None
    control_group: str | None = None
    control_administrator_group: str | None = None
    hosts: tuple[str, ...] = Field(default=(), max_length=16)
    proxies: tuple[str, ...] = Field(default=(), max_length=8)

    @property
    def udp_addresses(self) -> dict[str, tuple[str, int]]:
        """Addresses of datagrams by their text in the configuration."""
        return {text: (text.rpartition(":")[0], int(text.rpartition(":")[2])) for text in self.udp}

    @model_validator(mode="before")
    @classmethod
    def _refuse_old_keys(cls, given: Any) -> Any:
        return _refuse_old_keys(
            given,
            {"certificate": "tls_certificate", "key": "tls_key", "open": "anonymous_read"},
        )

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
    mark_timeout_s: float = Field(default=3.0, gt=0)
    ready_timeout_s: float = Field(default=60.0, gt=0)
    temperature_stale_s: float = Field(default=10.0, gt=0)
    navigation_stale_s: float = Field(default=5.0, gt=0)
    exposures_in_memory: int = Field(default=3, ge=2, le=16)
    disk_reserve_bytes: int = Field(default=500_000_000, ge=0)
    disk_warn_exposures: int = Field(default=100, ge=0)
    mirror_timeout_s: float = Field(default=2.0, gt=0)
    power_fail_s: float = Field(default=5.0, gt=0, le=60)


class Configuration(_ConfigurationSection):
    """The complete file."""

    mission: MissionSection
    plan: PlanSection = PlanSection()
    mount: MountSection = MountSection()
    serials: SerialsSection = SerialsSection()
    trigger: TriggerSection
    head: tuple[HeadDeviceSection, ...] = Field(min_length=1)
    thermometer: tuple[NamedDeviceSection, ...] = ()
    navigator: tuple[NamedDeviceSection, ...] = ()
    pps: tuple[NamedDeviceSection, ...] = Field(default=(), max_length=1)
    exposure: ExposureSection = ExposureSection()
    processing: ProcessingSection = ProcessingSection()
    limits: LimitsSection = LimitsSection()
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


def load(path: Path) -> tuple[Configuration, Rig]:
    """Read a service configuration and the rig it names.

    Relative paths are relative to the folder of the file.

    Raises:
        ConfigurationError: with one sentence per error: file, key, value, and the correction.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ConfigurationError([f"{path}: not a regular file; give a service.toml"])
        if status.st_size > CONFIGURATION_MAX_BYTES:
            raise ConfigurationError([f"{path.name}: too large for a configuration"])
        content = parse_toml(path.read_bytes())
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise ConfigurationError(
            [f"{path}: cannot be read ({reason}); give the path of a service.toml"]
        ) from error
    except TomlError as error:
        raise ConfigurationError([f"{path.name}: not valid TOML: {error}"]) from error
    return from_mapping(content, path)


def from_mapping(content: Mapping[str, Any], path: Path) -> tuple[Configuration, Rig]:
    """Validate parsed TOML; `path` names the file in messages and anchors relative paths."""
    file = path.name
    problems = device_problems(content, file, frozenset(TriggerSection.model_fields))
    rig: Rig | None = None
    rig_name = nested_value(content, "mission", "rig")
    if isinstance(rig_name, str):
        try:
            rig = find_rig(_rig_path(rig_name, path))
        except RigError as error:
            problems += [f"{file}: mission.rig: {problem}" for problem in error.problems]
    configuration: Configuration | None = None
    try:
        configuration = Configuration.model_validate(content)
    except ValidationError as error:
        problems += [_sentence(file, detail) for detail in error.errors()]
    if rig is not None:
        problems += rig_problems(content, rig, file)
    radiometry = nested_value(content, "mission", "radiometry")
    if isinstance(radiometry, str) and not (path.parent / radiometry).is_dir():
        problems.append(
            f"{file}: mission.radiometry is {radiometry!r}, and there is no such folder; give the "
            "folder with a calibration of each sensor, or leave the key out"
        )
    plan_file = nested_value(content, "plan", "file")
    if isinstance(plan_file, str):
        try:
            read_plan(path.parent / plan_file)
        except PlanError as error:
            problems.append(f"{file}: plan.file: {error}")
    if configuration is not None and rig is not None and configuration.mission.mirror is not None:
        problems += mirror_problems(
            path.parent / configuration.mission.root,
            path.parent / configuration.mission.mirror,
            configuration.limits.mirror_timeout_s,
            configuration.limits.exposures_in_memory,
            rig,
            file,
        )
    model = nested_value(content, "plan", "elevation")
    if isinstance(model, str) and not (path.parent / model).is_file():
        problems.append(f"{file}: plan.elevation is {model!r}, and there is no such file")
    if problems or configuration is None or rig is None:
        raise ConfigurationError(problems)
    return _with_absolute_paths(configuration, path.parent.resolve()), rig


def _rig_path(name: str, path: Path) -> str:
    local_path = path.parent / name
    return str(local_path) if name.endswith(".toml") and local_path.exists() else name


def _with_absolute_paths(configuration: Configuration, folder: Path) -> Configuration:
    mission = configuration.mission
    radiometry = None if mission.radiometry is None else folder / mission.radiometry
    mission_section = mission.model_copy(
        update={
            "root": folder / mission.root,
            "mirror": None if mission.mirror is None else folder / mission.mirror,
            "radiometry": radiometry,
            "rig": _rig_path(mission.rig, folder / "service.toml"),
        }
    )
    plan = configuration.plan
    if plan.file is not None:
        plan = plan.model_copy(update={"file": folder / plan.file})
    if plan.elevation is not None:
        plan = plan.model_copy(update={"elevation": folder / plan.elevation})
    watch = configuration.watch
    if watch is not None:
        files = {name: getattr(watch, name) for name in _WATCH_FILES}
        update: dict[str, Any] = {
            name: folder / path for name, path in files.items() if path is not None
        }
        if watch.mavlink is not None and watch.mavlink.signing_key is not None:
            signing = {
                "signing_key": folder / watch.mavlink.signing_key,
                "signing_state": mission_section.root / SIGNING_STATE
                if watch.mavlink.signing_state is None
                else folder / watch.mavlink.signing_state,
            }
            update["mavlink"] = watch.mavlink.model_copy(update=signing)
        watch = watch.model_copy(update=update)
    return configuration.model_copy(
        update={"mission": mission_section, "plan": plan, "watch": watch}
    )


def _sentence(file: str, detail: Any) -> str:
    key = _key(detail["loc"])
    message = str(detail["msg"]).removeprefix("Value error, ")
    kind = detail["type"]
    if kind == "missing":
        return f"{file}: {key} is missing; {message.lower()}"
    if kind == "extra_forbidden":
        return f"{file}: {key} is not a key of this section; check the spelling"
    shown = repr(detail["input"])
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    return f"{file}: {key} is {shown}; {message[0].lower()}{message[1:]}"


def _key(location: Sequence[int | str]) -> str:
    key = ""
    for part in location:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else part
    return key
