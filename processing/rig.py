"""The rig: what the camera is made of, and the file that says so.

A leaf: it imports nothing of ours. What follows from the geometry (overlaps, parameter counts) is
in `processing.topology`; where a sensor's pixels fall in the virtual image is in
`processing.placement`.

Units and signs: image plane in mm, x right, y up, origin at the calibrated principal point,
nominal flight direction +y. Body axes x forward, y right, z down. Angles omega, phi, kappa in
radians with R = Rx(omega) Ry(phi) Rz(kappa), camera to object.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Timing = Literal["syntopic", "synchronous"]
Role = Literal["pan", "colour"]

RIG_FORMAT = 1
RIG_FILE_MAX_BYTES = 1_000_000
BANDS = ("pan", "red", "green", "blue", "nir", "red_edge")
JUSTIFICATIONS = ("right", "left")
COLOUR_FILTER_ARRAYS = ("none", "RGGB", "BGGR", "GRBG", "GBRG")


class RigError(ValueError):
    """A rig file that cannot be used; `problems` holds one sentence for each mistake found."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))


@dataclass(frozen=True)
class Drift:
    """What one kelvin of dC does to a sensor's place in its cone (DESIGN 5.3)."""

    x_um_per_k: float = 0.0
    y_um_per_k: float = 0.0
    rotation_urad_per_k: float = 0.0
    scale_ppm_per_k: float = 0.0
    sigma_um_per_k: float = 0.0
    lag_s: float = 0.0


@dataclass(frozen=True)
class Sensor:
    """One CCD: its pixels, its calibrated place in the layer of its cone, and its drift.

    `x_mm`, `y_mm` place the centre of the pixel array, `rotation_rad` turns it counter-clockwise,
    `scale` is near one. The place holds at `calibration_c`. `position_sigma_um` is the standard
    deviation of each calibrated coordinate. A left-justified sensor keeps its DN in the highest
    bits of a 16-bit word: word = DN * `words_per_dn`.
    """

    name: str
    serial: str
    width_px: int
    height_px: int
    pitch_um: float
    x_mm: float
    y_mm: float
    rotation_rad: float
    scale: float
    position_sigma_um: float
    calibration_c: float
    probe: str
    drift: Drift
    bits: int
    black_dn: float
    electrons_per_dn: float
    read_noise_e: float
    colour_filter_array: str
    tdi_row_sign: int
    justified: str = "right"

    @property
    def pitch_mm(self) -> float:
        return self.pitch_um * 1e-3

    @property
    def full_scale_dn(self) -> int:
        return (1 << self.bits) - 1

    @property
    def words_per_dn(self) -> int:
        """What one DN adds to a stored word: 1, or 2^(16 - bits) where DN are left-justified."""
        return 1 << (16 - self.bits) if self.justified == "left" else 1


@dataclass(frozen=True)
class Lens:
    """Principal distance and the Australis ten, eq. 5.1 of seeds/dmc-calibration.txt.

    The correction carries *measured* image coordinates to *ideal* ones: ideal = measured + delta.
    `f_ppm_per_k` is the drift of the principal distance against dC of the cone's probe.
    """

    f_mm: float
    f_ppm_per_k: float
    f_number: float
    serial: str
    dx0_mm: float
    dy0_mm: float
    df_mm: float
    k1: float
    k2: float
    k3: float
    p1: float
    p2: float
    b1: float
    b2: float


@dataclass(frozen=True)
class Cone:
    """One lens with one focal plane.

    `position_mm` is the projection centre in the body frame; `rotation_rad` is (omega, phi, kappa)
    of master_from_cone, the platform calibration.
    """

    name: str
    role: Role
    bands: tuple[str, ...]
    position_mm: tuple[float, float, float]
    rotation_rad: tuple[float, float, float]
    probe: str
    calibration_c: float
    mark_to_mid_exposure_ns: int
    lens: Lens
    sensors: tuple[Sensor, ...]


@dataclass(frozen=True)
class VirtualImage:
    """The stitched image: a central perspective of `f_mm` on a raster centred on the axis."""

    width_px: int
    height_px: int
    pitch_um: float
    f_mm: float
    colour_ratio: int

    @property
    def pitch_mm(self) -> float:
        return self.pitch_um * 1e-3

    @property
    def colour_width_px(self) -> int:
        return self.width_px // self.colour_ratio

    @property
    def colour_height_px(self) -> int:
        return self.height_px // self.colour_ratio


@dataclass(frozen=True)
class Rig:
    """A camera of several heads, as its file tells it."""

    name: str
    title: str
    timing: Timing
    frame_interval_s: float
    master_cone: str
    colour_master_cone: str | None
    reference_cone: str
    calibration_id: str
    calibration_date: str
    virtual_image: VirtualImage | None
    cones: tuple[Cone, ...]

    def cone(self, name: str) -> Cone:
        """The cone of that name; KeyError names those there are."""
        for cone in self.cones:
            if cone.name == name:
                return cone
        raise KeyError(f"no cone {name!r}; the rig has {', '.join(c.name for c in self.cones)}")

    def cone_of(self, sensor_name: str) -> Cone:
        """The cone that carries a sensor."""
        for cone in self.cones:
            if any(sensor.name == sensor_name for sensor in cone.sensors):
                return cone
        raise KeyError(f"no sensor {sensor_name!r} in rig {self.name}")

    def sensor(self, name: str) -> Sensor:
        """The sensor of that name."""
        return next(s for s in self.cone_of(name).sensors if s.name == name)

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All sensors in file order."""
        return tuple(sensor for cone in self.cones for sensor in cone.sensors)

    @property
    def pan_cones(self) -> tuple[Cone, ...]:
        return tuple(cone for cone in self.cones if cone.role == "pan")

    @property
    def colour_cones(self) -> tuple[Cone, ...]:
        return tuple(cone for cone in self.cones if cone.role == "colour")

    @property
    def probes(self) -> tuple[str, ...]:
        """Names of the temperature probes the rig asks for, without repetition; "" is none."""
        named = [c.probe for c in self.cones] + [s.probe for s in self.sensors]
        return tuple(dict.fromkeys(name for name in named if name))


def shipped_rigs() -> dict[str, Path]:
    """Rig files that come with the package, by name."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "rigs").glob("*.toml"))}


def find_rig(name_or_path: str) -> Rig:
    """Load a shipped rig by its name, or any rig file by its path.

    Raises:
        RigError: no such rig, or a file with mistakes (all of them listed).
    """
    shipped = shipped_rigs()
    if name_or_path in shipped:
        return load_rig(shipped[name_or_path])
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.exists():
        return load_rig(path)
    known = ", ".join(shipped)
    raise RigError([f"rig {name_or_path!r} is neither a file nor one of: {known}"])


def load_rig(path: Path) -> Rig:
    """Read and validate a rig file.

    Raises:
        RigError: with one sentence per mistake: file, key, value, and what would be right.
    """
    try:
        if path.stat().st_size > RIG_FILE_MAX_BYTES:
            raise RigError([f"{path.name}: larger than {RIG_FILE_MAX_BYTES} bytes; not a rig file"])
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise RigError([f"{path}: cannot be read ({reason}); give a readable file"]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RigError([f"{path.name}: not valid TOML ({error})"]) from error
    return rig_from_mapping(content, path.name)


def rig_from_mapping(content: Mapping[str, Any], file: str) -> Rig:
    """Build a rig from parsed TOML; `file` names it in the error sentences."""
    problems: list[str] = []
    top = _Table(content, "", file, problems)
    if top.integer("format", RIG_FORMAT) != RIG_FORMAT:
        top.complain("format", f"this version reads format {RIG_FORMAT}")
    defaults = top.table("defaults", optional=True)
    calibration = top.table("calibration")
    image = top.table("virtual_image", optional=True)
    rig = Rig(
        name=top.text("name"),
        title=top.text("title", ""),
        timing="synchronous"
        if top.choice("timing", ("syntopic", "synchronous")) == "synchronous"
        else "syntopic",
        frame_interval_s=top.number("frame_interval_s", positive=True),
        master_cone=top.text("master_cone"),
        colour_master_cone=top.text("colour_master_cone", "") or None,
        reference_cone=top.text("reference_cone"),
        calibration_id=calibration.text("id"),
        calibration_date=calibration.text("date"),
        virtual_image=_virtual_image(image) if image.content else None,
        cones=tuple(_cone(cone, defaults) for cone in top.tables("cone")),
    )
    for table in (defaults, calibration, image, top):
        table.refuse_unknown()
    _check_names(rig, file, problems)
    if problems:
        raise RigError(problems)
    return rig


def _virtual_image(table: _Table) -> VirtualImage:
    return VirtualImage(
        width_px=table.integer("width_px", positive=True),
        height_px=table.integer("height_px", positive=True),
        pitch_um=table.number("pitch_um", positive=True),
        f_mm=table.number("f_mm", positive=True),
        colour_ratio=table.integer("colour_ratio", 1, positive=True),
    )


def _cone(table: _Table, defaults: _Table) -> Cone:
    probe = table.text("probe")
    calibration_c = table.number("calibration_c")
    bands = table.texts("bands")
    for band in bands:
        if band not in BANDS:
            table.complain("bands", f"a band is one of {', '.join(BANDS)}")
    lens_defaults = defaults.table("lens", optional=True)
    sensor_defaults = defaults.table("sensor", optional=True)
    lens = table.table("lens").over(lens_defaults)
    sensors = [s.over(sensor_defaults) for s in table.tables("sensor")]
    cone = Cone(
        name=table.text("name"),
        role="pan" if table.choice("role", ("pan", "colour")) == "pan" else "colour",
        bands=bands,
        position_mm=table.triple("position_mm"),
        rotation_rad=table.triple("rotation_rad"),
        probe=probe,
        calibration_c=calibration_c,
        mark_to_mid_exposure_ns=table.integer("mark_to_mid_exposure_ns", 0),
        lens=_lens(lens),
        sensors=tuple(_sensor(sensor, probe, calibration_c) for sensor in sensors),
    )
    table.refuse_unknown()
    return cone


def _lens(table: _Table) -> Lens:
    direction = table.text("direction", "ideal_from_measured")
    if direction != "ideal_from_measured":
        table.complain("direction", "a lens correction here is ideal_from_measured")
    number = table.number
    lens = Lens(
        f_mm=number("f_mm", positive=True),
        f_ppm_per_k=number("f_ppm_per_k", 0.0),
        f_number=number("f_number", 5.6, positive=True),
        serial=table.text("serial", ""),
        dx0_mm=number("dx0_mm", 0.0),
        dy0_mm=number("dy0_mm", 0.0),
        df_mm=number("df_mm", 0.0),
        k1=number("k1", 0.0),
        k2=number("k2", 0.0),
        k3=number("k3", 0.0),
        p1=number("p1", 0.0),
        p2=number("p2", 0.0),
        b1=number("b1", 0.0),
        b2=number("b2", 0.0),
    )
    table.refuse_unknown()
    return lens


def _sensor(table: _Table, probe: str, calibration_c: float) -> Sensor:
    drift = table.table("drift", optional=True)
    sign = table.integer("tdi_row_sign", 1)
    if sign not in (-1, 1):
        table.complain("tdi_row_sign", "it is 1 (charge moves to higher rows) or -1")
    bits = table.integer("bits", 12, positive=True)
    if bits > 16:
        table.complain("bits", "a pixel has at most 16 bits")
    sensor = Sensor(
        name=table.text("name"),
        serial=table.text("serial", ""),
        width_px=table.integer("width_px", positive=True),
        height_px=table.integer("height_px", positive=True),
        pitch_um=table.number("pitch_um", positive=True, says="a pixel pitch is positive"),
        x_mm=table.number("x_mm"),
        y_mm=table.number("y_mm"),
        rotation_rad=table.number("rotation_rad", 0.0),
        scale=table.number("scale", 1.0, positive=True),
        position_sigma_um=table.number("position_sigma_um", 0.0),
        calibration_c=table.number("calibration_c", calibration_c),
        probe=table.text("probe", probe),
        drift=Drift(
            x_um_per_k=drift.number("x_um_per_k", 0.0),
            y_um_per_k=drift.number("y_um_per_k", 0.0),
            rotation_urad_per_k=drift.number("rotation_urad_per_k", 0.0),
            scale_ppm_per_k=drift.number("scale_ppm_per_k", 0.0),
            sigma_um_per_k=drift.number("sigma_um_per_k", 0.0),
            lag_s=drift.number("lag_s", 0.0),
        ),
        bits=bits,
        black_dn=table.number("black_dn", 0.0),
        electrons_per_dn=table.number("electrons_per_dn", 1.0, positive=True),
        read_noise_e=table.number("read_noise_e", 0.0),
        colour_filter_array=table.choice("colour_filter_array", COLOUR_FILTER_ARRAYS, "none"),
        tdi_row_sign=sign,
        justified=table.choice("justified", JUSTIFICATIONS, "right"),
    )
    drift.refuse_unknown()
    table.refuse_unknown()
    return sensor


def _check_names(rig: Rig, file: str, problems: list[str]) -> None:
    cones = [cone.name for cone in rig.cones]
    sensors = [sensor.name for sensor in rig.sensors]
    for kind, names in (("cone", cones), ("sensor", sensors)):
        twice = dict.fromkeys(name for name in names if names.count(name) > 1)
        problems.extend(f"{file}: {kind} name {n!r} is used twice; names are unique" for n in twice)
    for key in ("master_cone", "colour_master_cone", "reference_cone"):
        name = getattr(rig, key)
        if name is not None and name not in cones:
            listed = ", ".join(cones) or "none"
            problems.append(f"{file}: {key} is {name!r}; it names a cone of this rig: {listed}")
    problems.extend(
        f"{file}: cone {cone.name!r} has no sensor; give it [[cone.sensor]]"
        for cone in rig.cones
        if not cone.sensors
    )
    problems.extend(
        f"{file}: sensor {sensor.name!r} is left-justified; a rig with [virtual_image] has "
        f"right-justified words"
        for sensor in rig.sensors
        if rig.virtual_image is not None and sensor.justified == "left"
    )


class _Table:
    """A TOML table that answers typed questions and notes every mistake with its full key."""

    def __init__(
        self, content: Mapping[str, Any], path: str, file: str, problems: list[str]
    ) -> None:
        self.content = content
        self.path = path
        self.file = file
        self.problems = problems
        self.asked: set[str] = set()

    def complain(self, key: str, cure: str) -> None:
        found = f"is {self.content[key]!r}" if key in self.content else "is missing"
        self.problems.append(f"{self.file}: {self._key(key)} {found}; {cure}")

    def number(
        self, key: str, default: float | None = None, *, positive: bool = False, says: str = ""
    ) -> float:
        value = self._get(key, default, "a number is needed")
        if value is None:
            return 1.0
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            self.complain(key, "a finite number is needed")
            return 1.0
        if positive and value <= 0:
            self.complain(key, says or "it is positive")
            return 1.0
        return float(value)

    def integer(self, key: str, default: int | None = None, *, positive: bool = False) -> int:
        value = self._get(key, default, "a whole number is needed")
        if value is None:
            return 1
        if isinstance(value, bool) or not isinstance(value, int):
            self.complain(key, "a whole number is needed")
            return 1
        if positive and value <= 0:
            self.complain(key, "it is positive")
            return 1
        return value

    def text(self, key: str, default: str | None = None) -> str:
        value = self._get(key, default, "a text is needed")
        if value is not None and not isinstance(value, str):
            self.complain(key, "a text is needed")
            return ""
        return value or ""

    def choice(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        value = self._get(key, default, f"it is one of {', '.join(allowed)}")
        if value is not None and value not in allowed:
            self.complain(key, f"it is one of {', '.join(allowed)}")
        return value if isinstance(value, str) and value in allowed else allowed[0]

    def texts(self, key: str) -> tuple[str, ...]:
        value = self._get(key, None, "a list of texts is needed")
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            if value is not None:
                self.complain(key, "a list of texts is needed")
            return ()
        return tuple(value)

    def triple(self, key: str) -> tuple[float, float, float]:
        value = self._get(key, None, "three numbers are needed")
        good = (
            isinstance(value, list)
            and len(value) == 3
            and all(isinstance(v, int | float) and math.isfinite(v) for v in value)
        )
        if not good:
            if value is not None:
                self.complain(key, "three numbers are needed")
            return (0.0, 0.0, 0.0)
        return (float(value[0]), float(value[1]), float(value[2]))

    def table(self, key: str, *, optional: bool = False) -> _Table:
        value = self._get(key, {} if optional else None, f"a table [{self._key(key)}] is needed")
        if value is not None and not isinstance(value, dict):
            self.complain(key, "a table is needed")
        content = value if isinstance(value, dict) else {}
        return _Table(content, self._key(key), self.file, self.problems)

    def tables(self, key: str) -> Iterator[_Table]:
        value = self._get(key, None, f"at least one [[{self._key(key)}]] is needed")
        if value is not None and not (
            isinstance(value, list) and all(isinstance(v, dict) for v in value)
        ):
            self.complain(key, f"a list of tables [[{self._key(key)}]] is needed")
            value = None
        for index, content in enumerate(value or ()):
            yield _Table(content, f"{self._key(key)}[{index}]", self.file, self.problems)

    def over(self, defaults: _Table) -> _Table:
        """This table with another's values where it has none of its own."""
        defaults.asked.update(defaults.content)
        return _Table({**defaults.content, **self.content}, self.path, self.file, self.problems)

    def refuse_unknown(self) -> None:
        for key in self.content:
            if key not in self.asked:
                self.complain(key, "no such key; check the spelling")

    def _get(self, key: str, default: Any, cure: str) -> Any:
        self.asked.add(key)
        if key not in self.content:
            if default is None:
                self.complain(key, cure)
            return default
        return self.content[key]

    def _key(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key
