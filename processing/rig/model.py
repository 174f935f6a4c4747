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
from typing import Final, Literal

VIRTUAL_CAMERA: Final = "virtual"
"""Name of the camera between converging heads in tables of cones."""

CALIBRATION_VALID_DAYS: Final = 730
"""Default of the rig file: customers require a calibration of the last two years."""

Timing = Literal["syntopic", "synchronous"]
Role = Literal["pan", "colour"]


@dataclass(frozen=True)
class ThermalDrift:
    """What one kelvin of dC does to a sensor's place in its cone.

    Source: docs/mathematics/drift.md#linear-model.
    """

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
    deviation of each calibrated coordinate. Perspective skew: what without it lay (x, y) mm from
    the centre, along the axes of the layer, lies at (x, y) * (1 + 1e-6 * (skew_x_ppm_per_mm * x +
    skew_y_ppm_per_mm * y)). A left-justified sensor keeps its DN in the highest bits of a 16-bit
    word: word = DN * `raw_units_per_dn`.
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
    drift: ThermalDrift
    bits: int
    black_dn: float
    electrons_per_dn: float
    read_noise_e: float
    colour_filter_array: str
    tdi_row_sign: int
    justified: str = "right"
    skew_x_ppm_per_mm: float = 0.0
    skew_y_ppm_per_mm: float = 0.0

    @property
    def pitch_mm(self) -> float:
        return self.pitch_um * 1e-3

    @property
    def skew_per_mm(self) -> tuple[float, float]:
        return (self.skew_x_ppm_per_mm * 1e-6, self.skew_y_ppm_per_mm * 1e-6)

    @property
    def full_scale_dn(self) -> int:
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

    x_mm: tuple[float, ...]
    y_mm: tuple[float, ...]
    dx_um: tuple[tuple[float, ...], ...]
    dy_um: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Lens:
    """Principal distance and the Australis ten, Heier et al. (2002), eq. 5.1.

    The correction carries *measured* image coordinates to *ideal* ones: ideal = measured + delta,
    with what `residual_grid` adds. `f_ppm_per_k` is the drift of the principal distance against dC
    of the cone's probe, `f_sigma_ppm` the standard deviation of the calibrated principal distance.
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
    residual_grid: LensGrid | None = None
    f_sigma_ppm: float = 20.0


@dataclass(frozen=True)
class Cone:
    """One lens with one focal plane.

    `position_mm` is the projection centre in the body frame; `rotation_rad` is (omega, phi, kappa)
    of master_from_cone, the platform calibration, each small rotation with a standard deviation of
    `rotation_sigma_urad`. Where no cone is the master, master stands for the virtual camera.
    """

    name: str
    role: Role
    bands: tuple[str, ...]
    position_mm: tuple[float, float, float]
    rotation_rad: tuple[float, float, float]
    probe: str
    calibration_c: float
    mark_to_mid_exposure_ns: int
    mark_to_mid_exposure_sigma_ns: int
    lens: Lens
    sensors: tuple[Sensor, ...]
    rotation_sigma_urad: float = 30.0


@dataclass(frozen=True)
class VirtualImage:
    """The stitched image: a central perspective of `f_mm` on a raster centred on the axis.

    `colour_ratio`, pixels to the colour pixel, need not be whole; colour width and height are.
    """

    width_px: int
    height_px: int
    pitch_um: float
    f_mm: float
    colour_ratio: float

    @property
    def pitch_mm(self) -> float:
        return self.pitch_um * 1e-3

    @property
    def colour_width_px(self) -> int:
        return math.floor(self.width_px / self.colour_ratio + 1e-9)

    @property
    def colour_height_px(self) -> int:
        return math.floor(self.height_px / self.colour_ratio + 1e-9)


@dataclass(frozen=True)
class Rig:
    """A camera of several heads, as in its file.

    `master_cone` is None where all PAN heads converge and none of them is the virtual image plane:
    the virtual camera then stands in the middle of their projection centres. The calibration is
    trusted for `calibration_valid_days` after its date; `probe_serials` are those of the probes it
    was made with.
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
    probe_serials: Mapping[str, str] = field(default_factory=dict, hash=False)

    def cone(self, name: str | None) -> Cone:
        """The cone of that name; KeyError, None's too, names those there are."""
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
    def serials(self) -> dict[str, str]:
        """Serial numbers of the parts that have one: sensors by name, "lens ...", "probe ..."."""
        named = {sensor.name: sensor.serial for sensor in self.sensors}
        named |= {f"lens {cone.name}": cone.lens.serial for cone in self.cones}
        named |= {f"probe {name}": serial for name, serial in self.probe_serials.items()}
        return {name: serial for name, serial in named.items() if serial}

    @property
    def pan_cones(self) -> tuple[Cone, ...]:
        return tuple(cone for cone in self.cones if cone.role == "pan")

    @property
    def colour_cones(self) -> tuple[Cone, ...]:
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
