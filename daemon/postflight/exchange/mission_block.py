"""The block of a mission: its images, cameras and orientations in one local frame.

Images are the perspective ones of Level-2, or raw frames of single sensors, whose calibration at
the mission's mean temperature becomes pairs of rays and pixels.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from daemon.mission.exposure import Exposure
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store.frame_checks import tdi_shifts
from daemon.mission.store.level2 import BAND_ORDER
from daemon.orientation.antimeridian import mean_longitude
from daemon.orientation.exterior_orientation import ExteriorOrientation, sealed_exposures
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.orientation_inputs import read_orientation_inputs
from daemon.postflight.exchange.block import Block, BlockCamera, BlockError, BlockImage
from daemon.products.level3 import IMAGES as LEVEL3_IMAGES
from daemon.products.level3 import level3_root
from processing.geometry.forward_distortion import ForwardDistortion
from processing.geometry.placement import (
    SensorPlacement,
    corrected_mm_from_raw,
    head_placement,
)
from processing.geometry.rotation import rotation_from_angles
from processing.geometry.similarity import apply_similarity
from processing.pipelines.perspective import has_head_images, perspective_of
from processing.rig import Cone, Rig, Sensor, VirtualImage

Array = NDArray[np.float64]
ImageKind = Literal["perspective", "raw"]
KINDS: tuple[ImageKind, ...] = ("perspective", "raw")
StitchedImage = Literal["pan", "rgbn", "rgb", "cir"]
STITCHED: tuple[StitchedImage, ...] = ("pan", "rgbn", "rgb", "cir")
"""Images of a stitched rig: PAN and colour of Level-2, pansharpened ones of Level-3 in 8 bits."""
_GRID = 25
"""Pairs of rays and pixels along each side of a raw frame."""


@dataclass(frozen=True)
class MissionBlock:
    """The block, the rig file, whether it was emulated, and what is not in it.

    `stitched` is the image of a stitched rig; "pan" also where heads are images of their own.
    `missing` names oriented heads without an image, `failures` exposures that cannot be read.
    """

    block: Block
    rig: Rig
    crs: str
    simulated: bool
    missing: tuple[str, ...]
    failures: tuple[ExposureFailure, ...]
    stitched: StitchedImage = "pan"


@dataclass(frozen=True)
class _Head:
    """One camera before its images: `turn` (3, 3) is cone_from_camera."""

    camera: BlockCamera
    cone: str
    file: str
    turn: Array


def block_of_mission(
    mission: Mission,
    kind: ImageKind,
    *,
    stitched: StitchedImage = "pan",
    crs: str | None = None,
    trajectory_file: Path | None = None,
    mount_file: Path | None = None,
    only: Sequence[int] = (),
    position_sigma_m: tuple[float, float, float] | None = None,
) -> MissionBlock:
    """Orient the images of a mission.

    Args:
        kind: perspective images of Level-2 and Level-3, or raw frames of Level-0.
        stitched: which image of a stitched rig.
        position_sigma_m: east, north, up, in place of the receiver's own accuracies.

    Raises:
        BlockError: no image has an orientation, or the rig has no images of this kind.
        TrajectoryError, GeoreferenceError, OrientationError: as their modules say.
    """
    read = sealed_exposures(mission)
    exposures = [
        exposure
        for number, exposure in read.results.items()
        if exposure.mark_gps_ns is not None and (not only or number in only)
    ]
    failures = tuple(f for f in read.failures if not only or f.exposure in only)
    inputs = read_orientation_inputs(
        mission, exposures, crs=crs, trajectory_file=trajectory_file, mount_file=mount_file
    )
    rig = inputs.rig
    oriented = inputs.oriented(exposures)
    if stitched != "pan" and (kind == "raw" or rig.virtual_image is None):
        raise BlockError(
            f"rig {rig.name}: {stitched} is an image of stitched rigs; leave --stitched out, and "
            "take perspective images of a rig with a virtual image"
        )
    heads = (
        _perspective_heads(rig, stitched) if kind == "perspective" else _raw_heads(rig, exposures)
    )
    folder = _folders(mission, kind, stitched)
    if not oriented:
        raise BlockError(
            f"{mission.path}: no exposure has an attitude; give --trajectory with one that has it"
        )
    latitude = np.array([eo.latitude_deg for eo in oriented])
    longitude = np.array([eo.longitude_deg for eo in oriented])
    frame = LocalFrame(float(latitude.mean()), mean_longitude(longitude.tolist()))
    images, missing = [], []
    for eo in oriented:
        for index, head in enumerate(heads):
            if head.cone != eo.cone:
                continue
            source = folder(eo.exposure) / head.file
            if source.exists():
                images.append(_image(eo, index, head, source, frame, position_sigma_m))
            else:
                missing.append(f"{eo.exposure:06d} {head.camera.name}")
    if not images:
        raise BlockError(
            f"{mission.path}: no {kind} image of an oriented exposure is there; run "
            f"`syntopic {'pansharpen' if stitched in LEVEL3_IMAGES else 'process'}` first"
            f"{', or choose --images raw' if stitched == 'pan' else ''}"
        )
    used = sorted({image.camera for image in images})
    block = Block(
        name=mission.id,
        cameras=tuple(heads[index].camera for index in used),
        images=tuple(
            replace(image, camera=used.index(image.camera))
            for image in sorted(images, key=lambda image: (image.frame, image.camera))
        ),
        frame=frame,
        georeference=inputs.georeference,
    )
    simulated = any(exposure.simulated for exposure in exposures)
    return MissionBlock(block, rig, inputs.crs, simulated, tuple(missing), failures, stitched)


def _image(
    eo: ExteriorOrientation,
    index: int,
    head: _Head,
    source: Path,
    frame: LocalFrame,
    sigma_m: tuple[float, float, float] | None,
) -> BlockImage:
    place = [np.array([v]) for v in (eo.latitude_deg, eo.longitude_deg, eo.height_m)]
    horizontal, vertical = eo.horizontal_sigma_m, eo.vertical_sigma_m
    if sigma_m is None and horizontal is not None and vertical is not None:
        sigma_m = (horizontal, horizontal, vertical)
    local_from_enu = frame.local_from_enu(eo.latitude_deg, eo.longitude_deg)
    return BlockImage(
        name=f"{eo.exposure:06d}_{head.camera.name}",
        camera=index,
        frame=eo.exposure,
        centre_m=frame.from_geodetic(*place)[0],
        rotation=np.asarray(local_from_enu @ eo.enu_from_camera @ head.turn),
        sigma_m=sigma_m,
        eo=replace(eo, rotation=np.asarray(eo.rotation @ head.turn)),
        source=source,
        line=eo.line_id,
    )


def _folders(mission: Mission, kind: ImageKind, stitched: StitchedImage) -> Callable[[int], Path]:
    """The folder of an exposure's images by its number."""
    if kind == "raw":
        return mission.level0
    if stitched in LEVEL3_IMAGES:
        return lambda number: level3_root(mission) / exposure_name(number)
    return mission.level2


def _perspective_heads(rig: Rig, stitched: StitchedImage) -> list[_Head]:
    """A stitched image, or every head's own image."""
    if rig.virtual_image is not None:
        image = rig.virtual_image
        bands: tuple[str, ...] = ("pan",)
        if stitched == "rgbn":
            colour = {band for cone in rig.cones for band in cone.bands}
            bands = tuple(band for band in BAND_ORDER if band in colour)
            image = replace(
                image,
                width_px=image.colour_width_px,
                height_px=image.colour_height_px,
                pitch_um=image.pitch_um * float(image.colour_ratio),
                colour_ratio=1,
            )
        elif stitched in LEVEL3_IMAGES:
            bands = LEVEL3_IMAGES[stitched]
        serial = next((s.serial for s in rig.sensors if s.serial), "")
        camera = _pinhole(stitched, image, bands, serial, None)
        file = f"{stitched}-8.tif" if stitched in LEVEL3_IMAGES else f"{stitched}.tif"
        return [_Head(camera, rig.image_cone_name, file, np.eye(3))]
    if not has_head_images(rig):
        raise BlockError(
            f"rig {rig.name}: its bands are registered to one of them, so that there are no "
            "perspective images of heads; choose --images raw"
        )
    return [
        _Head(
            _pinhole(c.name, perspective_of(c), c.bands, c.sensors[0].serial, c.lens.f_number),
            c.name, f"{c.name}.tif", np.eye(3),
        )
        for c in rig.cones
    ]  # fmt: skip


def _pinhole(
    name: str, image: VirtualImage, bands: tuple[str, ...], serial: str, f_number: float | None
) -> BlockCamera:
    f_px = image.f_mm / image.pitch_mm
    centre = ((image.width_px - 1) / 2.0, (image.height_px - 1) / 2.0)
    model = ForwardDistortion(f_px, f_px, *centre)
    return BlockCamera(
        name, image.width_px, image.height_px, model, image.pitch_mm, bands, serial, f_number
    )


def _raw_heads(rig: Rig, exposures: Sequence[Exposure]) -> list[_Head]:
    """Every sensor as a camera, placed at the mean of the mission's temperatures."""
    readings: dict[str, list[float]] = {}
    shifts: dict[str, set[int]] = {}
    for exposure in exposures:
        for reading in exposure.temperatures:
            if reading.value_c is not None:
                readings.setdefault(reading.probe, []).append(reading.value_c)
        for frame in exposure.frames:
            found = tdi_shifts(frame, rig.sensor(frame.sensor))
            shifts.setdefault(frame.sensor, set()).add(found)
    varied = sorted(name for name, values in shifts.items() if len(values) > 1)
    if varied:
        raise BlockError(
            f"the TDI count of {', '.join(varied)} changes within the mission, and with it the "
            "principal point of raw frames; export parts of it with --only, or perspective images"
        )
    mean = {probe: statistics.fmean(values) for probe, values in readings.items()}
    ends = [{probe: pick(values) for probe, values in readings.items()} for pick in (min, max)]
    return [
        _raw_head(cone, sensor, mean, ends, min(shifts.get(sensor.name, {0})))
        for cone in rig.cones
        for sensor in cone.sensors
    ]


def _raw_head(
    cone: Cone,
    sensor: Sensor,
    mean: Mapping[str, float],
    ends: Sequence[Mapping[str, float]],
    shifts: int,
) -> _Head:
    columns, rows = np.meshgrid(
        np.linspace(-0.5, sensor.width_px - 0.5, _GRID),
        np.linspace(-0.5, sensor.height_px - 0.5, _GRID),
    )
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    own = VirtualImage(sensor.width_px, sensor.height_px, sensor.pitch_um, cone.lens.f_mm, 1)
    placed = head_placement(cone, sensor, own, mean, shifts)
    turn = rotation_from_angles("Z", [placed.similarity.rotation_rad])
    rays = _rays(placed, pixels, turn)
    f_px = cone.lens.f_mm / sensor.pitch_mm
    centre = pixels.mean(axis=0) - f_px * rays.mean(axis=0)
    drift_px = max(
        float(
            np.abs(_rays(head_placement(cone, sensor, own, end, shifts), pixels, turn) - rays).max()
        )
        for end in (*ends, mean)
    )
    camera = BlockCamera(
        name=sensor.name,
        width_px=sensor.width_px,
        height_px=sensor.height_px,
        model=ForwardDistortion(f_px, f_px, float(centre[0]), float(centre[1])),
        pitch_mm=sensor.pitch_mm,
        bands=cone.bands,
        serial=sensor.serial,
        f_number=cone.lens.f_number,
        rays=rays,
        pixels=pixels,
        drift_px=drift_px * f_px,
    )
    return _Head(camera, cone.name, f"{sensor.name}.tif", np.asarray(turn))


def _rays(placed: SensorPlacement, pixels: Array, turn: Array) -> Array:
    """x / z and y / z of pixels, x right, y down, in the axes of the sensor."""
    ideal = apply_similarity(placed.similarity, corrected_mm_from_raw(placed, pixels))
    about = np.column_stack([ideal, np.full(len(ideal), -placed.cone.lens.f_mm)]) @ turn
    return np.column_stack([-about[:, 0] / about[:, 2], about[:, 1] / about[:, 2]])
