"""The rig: what a camera of several heads is made of.

Units and signs: image plane in mm, x right, y up, origin at the calibrated principal point,
nominal flight direction +y. Body axes x forward, y right, z down. Angles omega, phi, kappa in
radians with R = Rx(omega) Ry(phi) Rz(kappa), camera to object. How a file becomes a rig is in
`processing.rig.rig_file`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, ConfigDict, Field, Strict

from processing.rig.value_types import Name, Number, Positive, Text, Triple

VIRTUAL_CAMERA: Final = "virtual"
"""Name of the camera between converging heads in tables of cones."""

CALIBRATION_VALID_DAYS: Final = 730
"""Default of the rig file: customers require a calibration of the last two years."""

UNCALIBRATED: Final = "uncalibrated"
"""How the id of a rig without calibration begins; no calibration may have such an id."""

SIDE_MAX_PX: Final = 65_535
SENSOR_MAX_PIXELS: Final = 200_000_000
IMAGE_MAX_PIXELS: Final = 500_000_000

Timing = Literal["syntopic", "synchronous"]
Role = Literal["pan", "colour"]
BANDS: Final = ("pan", "red", "green", "blue", "nir", "red_edge", "red_edge_2")
ColourFilterArray = Literal["none", "RGGB", "BGGR", "GRBG", "GBRG"]

SidePx = Annotated[int, Strict(), Field(ge=1, le=SIDE_MAX_PX)]
PitchUm = Annotated[float, Strict(), Field(ge=0.1, le=1000.0)]
FocalLengthMm = Annotated[float, Strict(), Field(ge=0.1, le=100_000.0)]
SkewPpmPerMm = Annotated[float, Strict(), Field(ge=-1000.0, le=1000.0)]
OffsetNs = Annotated[int, Strict(), Field(ge=-10_000_000_000, le=10_000_000_000)]


def _band(name: str) -> str:
    if name not in BANDS:
        raise ValueError(f"a band is one of {', '.join(BANDS)}")
    return name


Band = Annotated[
    str, Strict(), AfterValidator(_band), Field(json_schema_extra={"enum": list(BANDS)})
]


def _ascending(steps: tuple[float, ...]) -> tuple[float, ...]:
    """Two numbers or more, ascending by equal steps."""
    widths = [b - a for a, b in pairwise(steps)]
    if not widths or min(widths) <= 0 or max(widths) - min(widths) > 1e-6 * max(widths):
        raise ValueError("two numbers or more are needed, ascending by equal steps")
    return steps


Steps = Annotated[tuple[Number, ...], AfterValidator(_ascending)]
Rows = tuple[tuple[Number, ...], ...]

_KNOWN_KEYS_ONLY: Final = ConfigDict(extra="forbid", use_attribute_docstrings=True)


@dataclass(frozen=True)
class ThermalDrift:
    """What one kelvin of dC does to a sensor's place in its cone.

    Source: docs/explanation/mathematics/drift.md#linear-model.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    x_um_per_k: Number = 0.0
    """Shift to the right."""
    y_um_per_k: Number = 0.0
    """Shift up."""
    rotation_urad_per_k: Number = 0.0
    """Counter-clockwise rotation."""
    scale_ppm_per_k: Number = 0.0
    """Growth of the distances on the sensor."""
    sigma_um_per_k: Number = 0.0
    """Standard deviation of both shifts."""
    lag_s: Number = 0.0
    """Time constant with which the sensor follows its probe."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One CCD: its pixels, its calibrated place in the layer of its cone, and its drift.

    `x_mm`, `y_mm` place the centre of the pixel array, `rotation_rad` turns it counter-clockwise,
    `scale` is near one. The place holds at `calibration_c`. `position_sigma_um` is the standard
    deviation of each calibrated coordinate. Perspective skew: what without it lay (x, y) mm from
    the centre, along the axes of the layer, lies at (x, y) * (1 + 1e-6 * (skew_x_ppm_per_mm * x +
    skew_y_ppm_per_mm * y)). A left-justified sensor keeps its DN in the highest bits of a 16-bit
    word: word = DN * `raw_units_per_dn`.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    name: Name
    """Name of the sensor, of its files and of its head."""
    serial: Text = ""
    """Serial number of the head; compared when it connects. Empty: not compared."""
    width_px: SidePx
    """Columns of a frame."""
    height_px: SidePx
    """Rows of a frame."""
    pitch_um: PitchUm
    """Distance of pixel centres."""
    x_mm: Number
    """Centre of the pixel array in the layer, to the right."""
    y_mm: Number
    """Centre of the pixel array in the layer, up."""
    rotation_rad: Number = 0.0
    """Counter-clockwise rotation in the layer."""
    scale: Positive = 1.0
    """Scale against the nominal pitch, near one."""
    position_sigma_um: Number = 0.0
    """Standard deviation of each calibrated coordinate."""
    calibration_c: Number
    """Temperature at calibration; default: that of the cone."""
    probe: Text
    """Temperature probe; empty: none. Default: that of the cone."""
    drift: ThermalDrift = field(default_factory=ThermalDrift)
    """Drift with temperature."""
    bits: Annotated[int, Strict(), Field(ge=1, le=16)] = 12
    """Bits of a DN."""
    black_dn: Number = 0.0
    """Signal without light."""
    electrons_per_dn: Positive = 1.0
    """Electrons that raise the signal by one DN."""
    read_noise_e: Number = 0.0
    """Noise of the readout."""
    colour_filter_array: ColourFilterArray = "none"
    """Bayer pattern of pixels (0, 0), (1, 0), (0, 1), (1, 1), as (column, row)."""
    tdi_row_sign: Literal[-1, 1] = 1
    """1: TDI moves charge to higher rows; -1: to lower ones."""
    justified: Literal["right", "left"] = "right"
    """Whether a word is the DN (right) or the DN times 2^(16 - bits) (left)."""
    skew_x_ppm_per_mm: SkewPpmPerMm = 0.0
    """Perspective skew along x."""
    skew_y_ppm_per_mm: SkewPpmPerMm = 0.0
    """Perspective skew along y."""

    @property
    def pitch_mm(self) -> float:
        """Pixel pitch."""
        return self.pitch_um * 1e-3

    @property
    def skew_per_mm(self) -> tuple[float, float]:
        """Perspective skew along x and y, 1/mm."""
        return (self.skew_x_ppm_per_mm * 1e-6, self.skew_y_ppm_per_mm * 1e-6)

    @property
    def full_scale_dn(self) -> int:
        """Largest DN, 2^bits - 1."""
        return (1 << self.bits) - 1

    @property
    def raw_units_per_dn(self) -> int:
        """What one DN adds to a stored word: 1, or 2^(16 - bits) where DN are left-justified."""
        return 1 << (16 - self.bits) if self.justified == "left" else 1


@dataclass(frozen=True)
class LensGrid:
    """What a lens does beyond the Australis ten: corrections to be added to theirs.

    `dx_um`, `dy_um` are rows of nodes by `y_mm`, columns by `x_mm` (both evenly spaced, ascending);
    taken at the measured place, bilinear between nodes, beyond them that of the border.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    x_mm: Steps
    """Columns of nodes, ascending by equal steps."""
    y_mm: Steps
    """Rows of nodes, ascending by equal steps."""
    dx_um: Rows
    """Corrections in x, one list for each row of nodes."""
    dy_um: Rows
    """Corrections in y, one list for each row of nodes."""


@dataclass(frozen=True)
class Lens:
    """Principal distance and the Australis ten, Heier et al. (2002), eq. 5.1.

    The correction carries *measured* image coordinates to *ideal* ones: ideal = measured + delta,
    with what `residual_grid` adds. `f_ppm_per_k` is the drift of the principal distance against dC
    of the cone's probe, `f_sigma_ppm` the standard deviation of the calibrated principal distance.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    f_mm: FocalLengthMm
    """Principal distance; the focal length of a lens that is not calibrated."""
    f_ppm_per_k: Number = 0.0
    """Drift of the principal distance."""
    f_number: Positive = 5.6
    """Aperture of the calibration."""
    serial: Text = ""
    """Serial number of the lens; compared with `[serials]` of the service configuration."""
    dx0_mm: Number = 0.0
    """Principal point, x."""
    dy0_mm: Number = 0.0
    """Principal point, y."""
    df_mm: Number = 0.0
    """Correction of the principal distance."""
    k1: Number = 0.0
    """Radial distortion, mm^-2."""
    k2: Number = 0.0
    """Radial distortion, mm^-4."""
    k3: Number = 0.0
    """Radial distortion, mm^-6."""
    p1: Number = 0.0
    """Decentring distortion, mm^-1."""
    p2: Number = 0.0
    """Decentring distortion, mm^-1."""
    b1: Number = 0.0
    """Affinity."""
    b2: Number = 0.0
    """Shear."""
    residual_grid: LensGrid | None = None
    """Corrections in addition to these ten."""
    f_sigma_ppm: Positive = 20.0
    """Standard deviation of the principal distance."""


def _of_a_camera(sensor: Sensor) -> Sensor:
    """A sensor of no more pixels than memory for frames is meant for."""
    if sensor.width_px * sensor.height_px > SENSOR_MAX_PIXELS:
        raise ValueError(f"width_px times height_px is {SENSOR_MAX_PIXELS} at most")
    return sensor


def _with_full_grid(lens: Lens) -> Lens:
    """A lens whose grid, where it has one, has a value at every node."""
    if lens.residual_grid is not None:
        rows, columns = len(lens.residual_grid.y_mm), len(lens.residual_grid.x_mm)
        for key in ("dx_um", "dy_um"):
            lengths = [len(row) for row in getattr(lens.residual_grid, key)]
            if lengths != [columns] * rows:
                raise ValueError(
                    f"residual_grid.{key} needs {rows} lists of {columns} numbers, as y_mm and x_mm"
                )
    return lens


def _whole_stays_whole(ratio: float) -> float:
    return int(ratio) if ratio == int(ratio) else ratio


@dataclass(frozen=True, kw_only=True)
class Cone:
    """One lens with one focal plane.

    `position_mm` is the projection centre in the body frame; `rotation_rad` is (omega, phi, kappa)
    of master_from_cone, the platform calibration, each small rotation with a standard deviation of
    `rotation_sigma_urad`. Where no cone is the master, master stands for the virtual camera.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    name: Name
    """Name of the cone."""
    role: Role
    """Whether it is part of the panchromatic image."""
    bands: tuple[Band, ...]
    """Bands of its pixels."""
    position_mm: Triple
    """Projection centre in the body frame: forward, right, down."""
    rotation_rad: Triple
    """Omega, phi, kappa against the master cone or the virtual camera."""
    probe: Text
    """Temperature probe; empty: none."""
    calibration_c: Number
    """Temperature at calibration."""
    mark_to_mid_exposure_ns: OffsetNs = 0
    """From the event mark to mid-exposure."""
    mark_to_mid_exposure_sigma_ns: Annotated[OffsetNs, Field(ge=0)] = 1000
    """Standard deviation of that time, jitter included."""
    lens: Annotated[Lens, AfterValidator(_with_full_grid)]
    """The lens."""
    sensors: Annotated[
        tuple[Annotated[Sensor, AfterValidator(_of_a_camera)], ...],
        Field(alias="sensor", min_length=1),
    ]
    """The sensors in its focal plane."""
    rotation_sigma_urad: Positive = 30.0
    """Standard deviation of each small rotation."""
    wavelengths_nm: tuple[Positive, ...] = ()
    """Central wavelengths of the bands, nm, in their order; empty: not known."""


@dataclass(frozen=True)
class VirtualImage:
    """The stitched image: a central perspective of `f_mm` on a raster centred on the axis.

    `colour_ratio`, pixels to the colour pixel, need not be whole; colour width and height are.
    """

    __pydantic_config__ = _KNOWN_KEYS_ONLY

    width_px: SidePx
    """Columns of the stitched image."""
    height_px: SidePx
    """Rows of the stitched image."""
    pitch_um: PitchUm
    """Pixel size of the stitched image."""
    f_mm: FocalLengthMm
    """Principal distance of the stitched image."""
    colour_ratio: Annotated[Positive, AfterValidator(_whole_stays_whole)] = 1
    """Pixels along the side of a colour pixel."""

    @property
    def pitch_mm(self) -> float:
        """Pixel pitch."""
        return self.pitch_um * 1e-3

    @property
    def colour_width_px(self) -> int:
        """Whole colour pixels in a row."""
        return math.floor(self.width_px / self.colour_ratio + 1e-9)

    @property
    def colour_height_px(self) -> int:
        """Whole colour pixels in a column."""
        return math.floor(self.height_px / self.colour_ratio + 1e-9)


@dataclass(frozen=True)
class Rig:
    """A camera of several heads, as in its file.

    `master_cone` is None where all PAN heads converge and none of them is the virtual image plane:
    the virtual camera then stands in the middle of their projection centres. The calibration is
    trusted for `calibration_valid_days` after its date; `probe_serials` are those of the probes it
    was made with. The values of an uncalibrated rig are nominal: its `calibration_date` is empty,
    and its `calibration_id` is `UNCALIBRATED` with a digest of the file.
    """

    name: str
    title: str
    timing: Timing
    frame_interval_s: float
    master_cone: str | None
    colour_master_cone: str | None
    reference_cone: str
    calibration_id: str
    calibration_date: str
    virtual_image: VirtualImage | None
    cones: tuple[Cone, ...]
    calibration_valid_days: int = CALIBRATION_VALID_DAYS
    serial: str = ""
    probe_serials: Mapping[str, str] = field(default_factory=dict, hash=False)

    def cone(self, name: str | None) -> Cone:
        """The cone of that name.

        Args:
            name: of a cone; None names none.

        Returns:
            The cone.

        Raises:
            KeyError: there is no such cone; the message names those there are.
        """
        for cone in self.cones:
            if cone.name == name:
                return cone
        raise KeyError(f"no cone {name!r}; the rig has {', '.join(c.name for c in self.cones)}")

    def cone_of(self, sensor_name: str) -> Cone:
        """The cone that carries a sensor.

        Args:
            sensor_name: of a sensor.

        Returns:
            The cone.

        Raises:
            KeyError: there is no such sensor.
        """
        for cone in self.cones:
            if any(sensor.name == sensor_name for sensor in cone.sensors):
                return cone
        raise KeyError(f"no sensor {sensor_name!r} in rig {self.name}")

    def sensor(self, name: str) -> Sensor:
        """The sensor of that name.

        Args:
            name: of a sensor.

        Returns:
            The sensor.

        Raises:
            KeyError: there is no such sensor.
        """
        return next(s for s in self.cone_of(name).sensors if s.name == name)

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All sensors in file order."""
        return tuple(sensor for cone in self.cones for sensor in cone.sensors)

    @property
    def is_calibrated(self) -> bool:
        """Whether the rig file has the table `[calibration]`."""
        return self.calibration_date != ""

    @property
    def serials(self) -> dict[str, str]:
        """Serial numbers of the parts that have one: sensors by name, "lens ...", "probe ..."."""
        named = {sensor.name: sensor.serial for sensor in self.sensors}
        named |= {f"lens {cone.name}": cone.lens.serial for cone in self.cones}
        named |= {f"probe {name}": serial for name, serial in self.probe_serials.items()}
        return {name: serial for name, serial in named.items() if serial}

    @property
    def pan_cones(self) -> tuple[Cone, ...]:
        """Cones of role `pan`, in file order."""
        return tuple(cone for cone in self.cones if cone.role == "pan")

    @property
    def colour_cones(self) -> tuple[Cone, ...]:
        """Cones of role `colour`, in file order."""
        return tuple(cone for cone in self.cones if cone.role == "colour")

    @property
    def master_sensors(self) -> tuple[Sensor, ...]:
        """Sensors of the master cone; none where no cone is the master."""
        return () if self.master_cone is None else self.cone(self.master_cone).sensors

    @property
    def has_virtual_camera(self) -> bool:
        """Whether the virtual image belongs to no cone but to a camera between converging heads."""
        return self.virtual_image is not None and self.master_cone is None

    @property
    def image_cone_name(self) -> str:
        """The master cone's name, or that of the virtual camera."""
        return self.master_cone or VIRTUAL_CAMERA

    @property
    def image_position_mm(self) -> tuple[float, float, float]:
        """The projection centre of the virtual image in the body frame: the master cone's, else the
        middle of the PAN cones'."""
        if self.master_cone is not None:
            return self.cone(self.master_cone).position_mm
        x, y, z = zip(*(cone.position_mm for cone in self.pan_cones or self.cones), strict=True)
        return (sum(x) / len(x), sum(y) / len(y), sum(z) / len(z))

    @property
    def probes(self) -> tuple[str, ...]:
        """Names of the temperature probes the rig asks for, without repetition; "" is none."""
        named = [c.probe for c in self.cones] + [s.probe for s in self.sensors]
        return tuple(dict.fromkeys(name for name in named if name))
