"""Projection of a sensor's pixels to the virtual image plane, and back.

A placement composes TDI, TDM, skew, lens, principal distance, similarity S and layer
transformation P; adjusting S and P is the work of `processing.mosaic.free_mosaic`.

Source: docs/explanation/mathematics/coordinates.md#from-sensor-to-virtual-image; Ladstädter et al.
(2010), eq. 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.geometry.drift import cone_dc, physical_similarity, principal_distance, sensor_dc
from processing.geometry.lens import ideal_from_measured, measured_from_ideal
from processing.geometry.projective import apply_projective
from processing.geometry.similarity import Similarity, apply_similarity, invert_similarity
from processing.geometry.virtual_camera import GroundPlane, vip_from_layer
from processing.rig import Cone, Rig, Sensor, VirtualImage

Array = NDArray[np.float64]

NO_SKEW: Final = (0.0, 0.0)


@dataclass(frozen=True)
class SensorPlacement:
    """One sensor of one exposure in the virtual image plane: x_vip = P S u' (eq. 1).

    `similarity` is S, layer_from_sensor in the calibrated (ideal) layer; `layer` is P, the (3, 3)
    vip_from_layer homography in mm. `physical` is layer_from_sensor at the exposure's temperature
    in the physical layer, `f_ratio` = f_mm / f(T), `tdi_shifts` the N of the exposure.

    u' are raw sensor coordinates corrected for skew, lens and drift of the principal distance,
    expressed at the start position, so that an adjusted placement is
    `dataclasses.replace(start, similarity=..., layer=...)`.
    """

    sensor: Sensor
    cone: Cone
    similarity: Similarity
    layer: Array
    physical: Similarity
    f_ratio: float
    tdi_shifts: int

    @cached_property
    def start_similarity(self) -> Similarity:
        """S at calibration + TDM, whatever `similarity` has become by adjustment."""
        return _start_similarity(self.cone, self.physical, self.f_ratio)


def head_placement(
    cone: Cone,
    sensor: Sensor,
    image: VirtualImage,
    temperatures_c: Mapping[str, float],
    tdi_shifts: int = 0,
) -> SensorPlacement:
    """Placement of a sensor in its own head alone: no mounting, no rotation.

    Args:
        cone: the head.
        sensor: one of its sensors.
        image: the perspective it is placed in.
        temperatures_c: temperature by probe name, as for `nominal_placements`.
        tdi_shifts: N of the frame.

    Returns:
        The placement as if the head were the whole rig.
    """
    alone = replace(cone, role="pan", rotation_rad=(0.0, 0.0, 0.0), position_mm=(0.0, 0.0, 0.0))
    rig = Rig(
        name=cone.name,
        title="",
        timing="synchronous",
        frame_interval_s=1.0,
        master_cone=cone.name,
        colour_master_cone=None,
        reference_cone=cone.name,
        calibration_id="",
        calibration_date="",
        virtual_image=image,
        cones=(alone,),
    )
    return nominal_placements(rig, temperatures_c, {sensor.name: tdi_shifts})[sensor.name]


def nominal_placements(
    rig: Rig,
    temperatures_c: Mapping[str, float],
    tdi_shifts: Mapping[str, int],
    *,
    use_drift: bool = True,
    ground: GroundPlane | None = None,
) -> dict[str, SensorPlacement]:
    """Placements by calibration, TDM and platform calibration: the start of any stitching.

    Args:
        rig: the camera.
        temperatures_c: temperature by probe name. A probe without one leaves its sensors at their
            calibration temperature; the caller reports it
            (`processing.geometry.drift.missing_probes`).
        tdi_shifts: N of each frame by sensor name; a sensor without one has none.
        use_drift: False ignores the temperatures (places and principal distances as calibrated).
        ground: what a virtual camera projects onto; None takes its projection centres as one.

    Returns:
        One placement per sensor of the rig, by sensor name, in file order.

    Raises:
        ValueError: the rig has no virtual image, or `tdi_shifts` names what is no sensor of it.

    Example:
        >>> from processing.rig import find_rig
        >>> placements = nominal_placements(find_rig("ultracam-x-mini"), {}, {})
        >>> len(placements), placements["SU00"].similarity.rotation_rad
        (13, 3.92e-05)
    """
    if unknown := tdi_shifts.keys() - {sensor.name for sensor in rig.sensors}:
        raise ValueError(f"tdi_shifts names {min(unknown)!r}; rig {rig.name} has no such sensor")
    if rig.virtual_image is None:
        raise ValueError(f"rig {rig.name} has no [virtual_image]; nothing can be placed in it")
    known = temperatures_c if use_drift else {}
    placements: dict[str, SensorPlacement] = {}
    for cone in rig.cones:
        f_ratio = cone.lens.f_mm / principal_distance(cone, cone_dc(cone, known))
        layer = vip_from_layer(rig, cone, ground)
        for sensor in cone.sensors:
            physical = physical_similarity(sensor, sensor_dc(sensor, known))
            placements[sensor.name] = SensorPlacement(
                sensor=sensor,
                cone=cone,
                similarity=_start_similarity(cone, physical, f_ratio),
                layer=layer,
                physical=physical,
                f_ratio=f_ratio,
                tdi_shifts=tdi_shifts.get(sensor.name, 0),
            )
    return placements


def start_similarity(placement: SensorPlacement) -> Similarity:
    """S at calibration + TDM, whatever the placement's own S has become by adjustment.

    The sensor's centre goes to its lens-corrected place in the calibrated layer.

    Args:
        placement: start or adjusted.

    Returns:
        layer_from_sensor in the calibrated (ideal) layer, mm.
    """
    return placement.start_similarity


def _start_similarity(cone: Cone, physical: Similarity, f_ratio: float) -> Similarity:
    centre = ideal_from_measured(cone.lens, np.array([[physical.x_mm, physical.y_mm]]))[0]
    return Similarity(
        x_mm=float(centre[0]) * f_ratio,
        y_mm=float(centre[1]) * f_ratio,
        rotation_rad=physical.rotation_rad,
        scale=physical.scale * f_ratio,
    )


def sensor_mm_from_raw(placement: SensorPlacement, colrow: Array) -> Array:
    """Sensor coordinates u of raw pixels at mid-exposure.

    With N TDI shifts the content of row R belongs to row R - tdi_row_sign * N / 2.

    Args:
        placement: start or adjusted; its sensor and TDI count are used.
        colrow: (column, row), shape (n, 2), zero-based, integer at the pixel centre, row down.

    Returns:
        Points from the middle of the pixel array, shape (n, 2), mm, x right, y up.

    Source: docs/explanation/mathematics/coordinates.md#pixels-and-millimetres.

    Example:
        The upper left pixel of 1248 x 832, 7.2 um; 10 TDI shifts move it up by 5 rows.

        >>> from processing.rig import find_rig
        >>> rig = find_rig("ultracam-x-mini")
        >>> corner = np.array([[0.0, 0.0]])
        >>> sensor_mm_from_raw(nominal_placements(rig, {}, {})["SU00"], corner).round(4)
        array([[-4.4892,  2.9916]])
        >>> sensor_mm_from_raw(nominal_placements(rig, {}, {"SU00": 10})["SU00"], corner).round(4)
        array([[-4.4892,  3.0276]])
    """
    sensor = placement.sensor
    row_shift = sensor.tdi_row_sign * placement.tdi_shifts / 2.0
    u = np.empty((len(colrow), 2))
    u[:, 0] = (colrow[:, 0] - (sensor.width_px - 1) / 2.0) * sensor.pitch_mm
    u[:, 1] = ((sensor.height_px - 1) / 2.0 - (colrow[:, 1] - row_shift)) * sensor.pitch_mm
    return u


def raw_from_sensor_mm(placement: SensorPlacement, u_mm: Array) -> Array:
    """Inverse of `sensor_mm_from_raw`.

    Args:
        placement: start or adjusted; its sensor and TDI count are used.
        u_mm: points from the middle of the pixel array, shape (n, 2), mm, x right, y up.

    Returns:
        (column, row), shape (n, 2), zero-based, integer at the pixel centre, row down.

    Example:
        >>> from processing.rig import find_rig
        >>> placement = nominal_placements(find_rig("ultracam-x-mini"), {}, {})["SU00"]
        >>> raw_from_sensor_mm(placement, np.array([[0.0, 0.0]]))
        array([[623.5, 415.5]])
    """
    sensor = placement.sensor
    row_shift = sensor.tdi_row_sign * placement.tdi_shifts / 2.0
    colrow = np.empty((len(u_mm), 2))
    colrow[:, 0] = u_mm[:, 0] / sensor.pitch_mm + (sensor.width_px - 1) / 2.0
    colrow[:, 1] = (sensor.height_px - 1) / 2.0 - u_mm[:, 1] / sensor.pitch_mm + row_shift
    return colrow


def layer_mm_from_raw(sensor: Sensor, colrow: Array) -> Array:
    """Carry raw pixels into the physical layer, as the rig file places the sensor.

    Args:
        sensor: place, rotation, scale and perspective skew, at calibration temperature.
        colrow: (column, row), shape (n, 2), zero-based, integer at the pixel centre, row down.

    Returns:
        Points of the layer before lens correction, shape (n, 2), mm, x right, y up.

    Source: docs/explanation/mathematics/coordinates.md#pixels-and-millimetres.

    Example:
        The upper left pixel of 1248 x 832, 7.2 um.

        >>> from dataclasses import replace
        >>> from processing.rig import find_rig
        >>> sensor = find_rig("ultracam-x-mini").sensor("SU10")
        >>> sensor = replace(sensor, x_mm=0.0, y_mm=0.0, rotation_rad=0.0, scale=1.0)
        >>> layer_mm_from_raw(sensor, np.array([[0.0, 0.0]])).round(4)
        array([[-4.4892,  2.9916]])
    """
    u = np.empty((len(colrow), 2))
    u[:, 0] = (colrow[:, 0] - (sensor.width_px - 1) / 2.0) * sensor.pitch_mm
    u[:, 1] = ((sensor.height_px - 1) / 2.0 - colrow[:, 1]) * sensor.pitch_mm
    about = apply_similarity(Similarity(0.0, 0.0, sensor.rotation_rad, sensor.scale), u)
    if sensor.skew_per_mm != NO_SKEW:
        about = about * (1.0 + about @ sensor.skew_per_mm)[:, None]
    return np.asarray(about + np.array((sensor.x_mm, sensor.y_mm)))


def corrected_mm_from_raw(placement: SensorPlacement, colrow: Array) -> Array:
    """u' of eq. 1: what S and P act on, independent of their adjustment.

    Args:
        placement: start or adjusted.
        colrow: (column, row), shape (n, 2), zero-based, integer at the pixel centre, row down.

    Returns:
        Corrected sensor coordinates at the start position, shape (n, 2), mm, y up.

    Source: Ladstädter et al. (2010), eq. 1.
    """
    physical = apply_similarity(placement.physical, sensor_mm_from_raw(placement, colrow))
    if placement.sensor.skew_per_mm != NO_SKEW:
        physical = _skewed(placement, physical)
    ideal = ideal_from_measured(placement.cone.lens, physical) * placement.f_ratio
    return apply_similarity(invert_similarity(start_similarity(placement)), ideal)


def vip_mm_from_raw(placement: SensorPlacement, colrow: Array) -> Array:
    """Carry raw pixels into the virtual image plane.

    Args:
        placement: start or adjusted.
        colrow: (column, row), shape (n, 2), zero-based, integer at the pixel centre, row down.

    Returns:
        VIP points, shape (n, 2), mm, x right, y up.

    Source: Ladstädter et al. (2010), eq. 1.
    """
    corrected = corrected_mm_from_raw(placement, np.asarray(colrow, dtype=np.float64))
    return vip_mm_from_corrected(placement, corrected)


def vip_mm_from_corrected(placement: SensorPlacement, corrected_mm: Array) -> Array:
    """The last step of `vip_mm_from_raw`, from `corrected_mm_from_raw`.

    Args:
        placement: of the sensor.
        corrected_mm: u' (n, 2).

    Returns:
        Points (n, 2) of the virtual image plane, mm.
    """
    return apply_projective(placement.layer @ placement.similarity.matrix, corrected_mm)


def raw_from_vip_mm(placement: SensorPlacement, xy_mm: Array) -> Array:
    """Inverse of `vip_mm_from_raw`, exact to 1e-6 px.

    Args:
        placement: start or adjusted.
        xy_mm: VIP points, shape (n, 2), mm, x right, y up.

    Returns:
        (column, row), shape (n, 2), zero-based, row down. Points the lens polynomial cannot reach
        (far outside the cone's field) are NaN; points outside the sensor have coordinates outside
        its array.

    Example:
        >>> from processing.rig import find_rig
        >>> placement = nominal_placements(find_rig("ultracam-x-mini"), {}, {})["SU00"]
        >>> xy_mm = vip_mm_from_raw(placement, np.array([[100.0, 200.0]]))
        >>> raw_from_vip_mm(placement, xy_mm).round(6)
        array([[100., 200.]])
    """
    xy = np.asarray(xy_mm, dtype=np.float64)
    vip_from_ideal = (
        placement.layer
        @ placement.similarity.matrix
        @ invert_similarity(start_similarity(placement)).matrix
    )
    ideal = (
        apply_projective(np.asarray(np.linalg.inv(vip_from_ideal), np.float64), xy)
        / placement.f_ratio
    )
    physical = measured_from_ideal(placement.cone.lens, ideal)
    if placement.sensor.skew_per_mm != NO_SKEW:
        physical = _unskewed(placement, physical)
    return raw_from_sensor_mm(
        placement, apply_similarity(invert_similarity(placement.physical), physical)
    )


def _skewed(placement: SensorPlacement, physical_mm: Array) -> Array:
    """Perspective skew of the sensor: q (1 + k q) for q about its centre; (n, 2) to (n, 2)."""
    about = physical_mm - (placement.physical.x_mm, placement.physical.y_mm)
    return physical_mm + about * (about @ placement.sensor.skew_per_mm)[:, None]


def _unskewed(placement: SensorPlacement, physical_mm: Array) -> Array:
    """Inverse of `_skewed`: with w = k q the skewed point p has k p = w (1 + w)."""
    centre = np.array((placement.physical.x_mm, placement.physical.y_mm))
    about = physical_mm - centre
    with np.errstate(invalid="ignore"):
        w = (np.sqrt(1.0 + 4.0 * (about @ placement.sensor.skew_per_mm)) - 1.0) / 2.0
    return np.asarray(centre + about / (1.0 + w)[:, None])


def vip_px_from_mm(image: VirtualImage, xy_mm: Array) -> Array:
    """VIP pixels of VIP points.

    Args:
        image: size and pitch of the virtual image.
        xy_mm: shape (n, 2), mm from its middle, x right, y up.

    Returns:
        (column, row), shape (n, 2), zero-based, integer at the pixel centre, row down.

    Example:
        >>> image = VirtualImage(width_px=1001, height_px=601, pitch_um=10.0, f_mm=100.0)
        >>> vip_px_from_mm(image, np.array([[0.0, 0.0], [1.0, 1.0]])).round(6)
        array([[500., 300.],
               [600., 200.]])
    """
    colrow = np.empty((len(xy_mm), 2))
    colrow[:, 0] = xy_mm[:, 0] / image.pitch_mm + (image.width_px - 1) / 2.0
    colrow[:, 1] = (image.height_px - 1) / 2.0 - xy_mm[:, 1] / image.pitch_mm
    return colrow


def vip_mm_from_px(image: VirtualImage, colrow: Array) -> Array:
    """Inverse of `vip_px_from_mm`.

    Args:
        image: size and pitch of the virtual image.
        colrow: (column, row), shape (n, 2), zero-based, integer at the pixel centre, row down.

    Returns:
        VIP points, shape (n, 2), mm from its middle, x right, y up.

    Example:
        >>> image = VirtualImage(width_px=1001, height_px=601, pitch_um=10.0, f_mm=100.0)
        >>> vip_mm_from_px(image, np.array([[600.0, 200.0]])).round(6)
        array([[1., 1.]])
    """
    xy = np.empty((len(colrow), 2))
    xy[:, 0] = (colrow[:, 0] - (image.width_px - 1) / 2.0) * image.pitch_mm
    xy[:, 1] = ((image.height_px - 1) / 2.0 - colrow[:, 1]) * image.pitch_mm
    return xy
