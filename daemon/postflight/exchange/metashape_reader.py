"""Metashape's camera file (`cameras.xml`), read into a block in metres.

The transformation of a component carries its coordinates, which have a scale of their own, to the
earth's centre or to local coordinates. The block is in a local frame about its images.

Source: Agisoft Metashape User Manual, Professional Edition, version 2.1, appendix D "Camera
models"; files of its "Export Cameras" (document version 2.0.0).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.foreign_xml import XmlError, parse_xml
from daemon.orientation.geodesy import CRS, ECEF_FROM_GEODETIC, GEOGRAPHIC, CRSError
from daemon.orientation.local_frame import LocalFrame, enu_axes
from daemon.postflight.exchange.block import (
    VISION_FROM_CAMERA,
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
)
from daemon.postflight.exchange.metashape import TERMS
from processing.geometry.forward_distortion import ForwardDistortion

Array = NDArray[np.float64]

XML_MAX_BYTES: Final = 1_000_000_000
ELEMENTS_MAX: Final = 5_000_000
_CARRIED: Final = frozenset({"f", "cx", "cy", "b1", "b2", *TERMS})
_ORTHOGONAL_TO: Final = 1e-6
_EARTH_M: Final = (6.2e6, 6.5e6)
"""Distances from the earth's centre at which a component without a reference system lies on it."""
_AXES_WITHIN_M: Final = 0.5
"""Largest difference from an axis of WGS 84 with which another ellipsoid is taken as it."""


@dataclass(frozen=True)
class _Transform:
    """world = `rotation` @ (`scale` * chunk) + `translation`; in metres."""

    rotation: Array
    translation: Array
    scale: float


def read_metashape(path: Path) -> Block:
    """Read the aligned cameras of the one component of the one chunk of a camera file.

    Positions are in metres in a local frame where the component lies on the earth, in its local
    coordinates where the reference states them, and in units of the chunk (`Block.is_metric` false)
    where the component has no transformation.

    Raises:
        BlockError: no such file, several chunks or components, a sensor of another type than
            frame, or parameters that are not carried; it names them.
    """
    try:
        root = parse_xml(read_regular_file(path, XML_MAX_BYTES), elements_max=ELEMENTS_MAX)
    except (ForeignFileError, XmlError) as error:
        raise BlockError(f"{path}: {error}; give the file of Metashape's Export Cameras") from error
    chunks = root.findall("chunk")
    if len(chunks) != 1:
        raise BlockError(f"{path}: {len(chunks)} chunks; export one chunk to a file")
    try:
        return _block_of(path, chunks[0])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        found = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise BlockError(
            f"{path}: not Metashape's camera file: {found}; give the file of its Export Cameras"
        ) from error


def _block_of(path: Path, chunk: ET.Element) -> Block:
    sensors = _by_id(path, "sensor", chunk.iterfind("sensors/sensor"))
    every = _by_id(path, "camera", chunk.iterfind("cameras//camera"))
    for camera in every.values():
        if camera.attrib["sensor_id"] not in sensors:
            raise BlockError(
                f"{path}: camera {camera.attrib['label']} names sensor "
                f"{camera.attrib['sensor_id']}, which is not in the file"
            )
    numbers = {one: number for number, one in enumerate(every, 1)}
    disabled = {one for one, camera in every.items() if camera.get("enabled") in ("false", "0")}
    aligned = {
        one: found
        for one in every
        if one not in disabled and (found := _posed(path, every, one)) is not None
    }
    if not aligned:
        raise BlockError(f"{path}: no enabled camera has a transform; align the photos first")
    transform = _transform_of(path, chunk, [every[one] for one in aligned])
    scale = transform.scale if transform is not None else 1.0
    index: dict[str, int] = {}
    cameras: list[BlockCamera] = []
    images: list[BlockImage] = []
    notes: list[str] = []
    for one, (pose, from_master) in aligned.items():
        camera = every[one]
        sensor = camera.attrib["sensor_id"]
        if sensor not in index:
            index[sensor] = len(cameras)
            cameras.append(_camera_of(path, sensors[sensor]))
        turn, centre = pose[:3, :3], pose[:3, 3] * scale
        if from_master:
            own, offset_m = _slave(path, sensors[sensor])
            if offset_m.any() and scale != 1.0:
                note = (
                    f"sensor {cameras[index[sensor]].name}: its offset from the master, "
                    f"{float(np.linalg.norm(offset_m)):.4g}, is taken as metres"
                )
                notes += [note] if note not in notes else []
            turn, centre = turn @ own, centre + turn @ offset_m
        images.append(
            BlockImage(
                camera.attrib["label"],
                index[sensor],
                numbers[camera.get("master_id", one)],
                np.asarray(centre),
                np.asarray(turn @ VISION_FROM_CAMERA),
            )
        )
    for what, left_out in (
        ("disabled and left out", [one for one in every if one in disabled]),
        ("not aligned", [one for one in every if one not in aligned and one not in disabled]),
    ):
        names = ", ".join(every[one].attrib["label"] for one in left_out)
        notes += [f"{what}: {names}"] if names else []
    if any(camera.find("rolling_shutter") is not None for camera in every.values()):
        notes.append("rolling shutter compensation of Metashape is not carried")
    name = chunk.get("label", path.stem)
    return _placed(path, chunk, Block(name, tuple(cameras), tuple(images)), transform, notes)


def _by_id(path: Path, what: str, elements: Iterable[ET.Element]) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for one in elements:
        if one.attrib["id"] in found:
            raise BlockError(
                f"{path}: {what} {one.attrib['id']} ({one.get('label', '')}) is there twice; "
                "export the cameras again"
            )
        found[one.attrib["id"]] = one
    return found


def _posed(path: Path, every: Mapping[str, ET.Element], one: str) -> tuple[Array, bool] | None:
    """Pose (4, 4) of a camera in the chunk, or of its master where it has none itself."""
    camera, from_master = every[one], False
    if camera.find("transform") is None and camera.get("master_id", one) != one:
        master = camera.attrib["master_id"]
        if master not in every:
            raise BlockError(
                f"{path}: camera {camera.attrib['label']} names master {master}, which is not in "
                "the file"
            )
        camera, from_master = every[master], True
    text = camera.findtext("transform")
    if text is None:
        return None
    pose = _numbers(text, 16).reshape(4, 4)
    if not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise BlockError(
            f"{path}: camera {camera.attrib['label']}: the last row of its transform is "
            f"{' '.join(f'{value:g}' for value in pose[3])}; 0 0 0 1 is right. Export it again"
        )
    _orthogonal(pose[:3, :3], f"{path}: camera {camera.attrib['label']}: its transform")
    return pose, from_master


def _slave(path: Path, sensor: ET.Element) -> tuple[Array, Array]:
    """master_from_slave (3, 3) and the slave's place in the axes of the master, vision axes."""
    turn, place = sensor.findtext("rotation"), sensor.findtext("translation")
    rotation = np.eye(3) if turn is None else _numbers(turn, 9).reshape(3, 3)
    _orthogonal(rotation, f"{path}: sensor {sensor.attrib['label']}: its rotation")
    return rotation, np.zeros(3) if place is None else _numbers(place, 3)


def _transform_of(
    path: Path, chunk: ET.Element, aligned: Sequence[ET.Element]
) -> _Transform | None:
    """Of the component that has the aligned cameras, else of the chunk; None without any."""
    components = {one.attrib["id"]: one for one in chunk.iterfind("components/component")}
    counts: dict[str, int] = {}
    for camera in aligned:
        of = camera.get("component_id", next(iter(components), ""))
        counts[of] = counts.get(of, 0) + 1
    if len(counts) > 1:
        listed = ", ".join(
            f"{components[of].get('label', of) if of in components else of} ({count} cameras)"
            for of, count in counts.items()
        )
        raise BlockError(
            f"{path}: {len(counts)} components, {listed}; they are not in the same frame. Export "
            "one: remove or merge the others in Metashape"
        )
    component = components.get(next(iter(counts)))
    found = component.find("transform") if component is not None else None
    if found is None:
        found = chunk.find("transform")
    if found is None or not len(found):
        return None
    rotation = _numbers(found.findtext("rotation") or "1 0 0 0 1 0 0 0 1", 9).reshape(3, 3)
    translation = _numbers(found.findtext("translation") or "0 0 0", 3)
    (scale,) = _numbers(found.findtext("scale") or "1", 1).tolist()
    _orthogonal(rotation, f"{path}: the transform of the component")
    if scale <= 0.0:
        raise BlockError(f"{path}: the transform of the component has scale {scale:g}")
    return _Transform(rotation, translation, float(scale))


def _placed(
    path: Path, chunk: ET.Element, block: Block, transform: _Transform | None, notes: list[str]
) -> Block:
    """The block in metres in a local frame, in local coordinates, or in units of the chunk."""
    if transform is None:
        notes.append("the chunk has no transformation: positions are in its units, not in metres")
        return replace(block, is_metric=False, notes=tuple(notes))
    place = np.array([image.centre_m for image in block.images])
    world = place @ transform.rotation.T + transform.translation
    crs = _reference_of(path, chunk)
    far_m = float(np.linalg.norm(world.mean(axis=0)))
    if crs is not None and crs.is_engineering:
        notes.append("positions are in the local coordinates of the chunk's reference")
        return _moved(block, world, transform.rotation, None, notes)
    if not _EARTH_M[0] < far_m < _EARTH_M[1]:
        notes.append("the chunk is not on the earth: positions may not be in metres")
        moved = _moved(block, world, transform.rotation, None, notes)
        return replace(moved, is_metric=False)
    if crs is not None:
        _check_datum(path, crs, notes)
    frame = _level_frame(transform)
    if frame is not None:
        return replace(block, frame=frame, notes=tuple(notes))
    x, y, z = world.mean(axis=0).tolist()
    longitude, latitude, _ = ECEF_FROM_GEODETIC.transform(x, y, z, direction="INVERSE")
    frame = LocalFrame(float(latitude), float(longitude))
    axes = enu_axes(frame.latitude_deg, frame.longitude_deg)
    origin = ECEF_FROM_GEODETIC.transform(frame.longitude_deg, frame.latitude_deg, 0.0)
    local = (world - np.array(origin)) @ axes
    return _moved(block, local, axes.T @ transform.rotation, frame, notes)


def _moved(
    block: Block, place: Array, turn: Array, frame: LocalFrame | None, notes: Sequence[str]
) -> Block:
    images = tuple(
        replace(image, centre_m=centre, rotation=np.asarray(turn @ image.rotation))
        for image, centre in zip(block.images, place, strict=True)
    )
    return replace(block, images=images, frame=frame, notes=tuple(notes))


def _reference_of(path: Path, chunk: ET.Element) -> CRS | None:
    """The coordinate system of the reference, horizontal; None where the file has none."""
    wkt = (chunk.findtext("reference") or "").strip()
    if not wkt:
        return None
    try:
        crs = CRS.from_wkt(wkt)
    except CRSError as error:
        raise BlockError(f"{path}: reference {wkt[:60]!r} is no coordinate system") from error
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    units = {axis.unit_name for axis in crs.axis_info}
    if crs.is_engineering and units - {"metre"}:
        raise BlockError(
            f"{path}: local coordinates in {', '.join(sorted(units))}; those in metres are carried"
        )
    return crs


def _check_datum(path: Path, crs: CRS, notes: list[str]) -> None:
    """Refuse another ellipsoid than that of WGS 84, and note another datum."""
    ours = CRS(GEOGRAPHIC).ellipsoid
    theirs = crs.ellipsoid
    if (
        ours is None
        or theirs is None
        or (
            abs(theirs.semi_major_metre - ours.semi_major_metre) > _AXES_WITHIN_M
            or abs(theirs.semi_minor_metre - ours.semi_minor_metre) > _AXES_WITHIN_M
        )
    ):
        raise BlockError(
            f"{path}: reference {crs.name} is not on the ellipsoid of WGS 84; convert the chunk's "
            "reference to WGS 84 in Metashape"
        )
    datum = crs.datum.name if crs.datum is not None else crs.name
    if "WGS" not in datum.upper() and "World Geodetic System" not in datum:
        notes.append(f"coordinates are those of {crs.name}, datum {datum}")


def _level_frame(transform: _Transform) -> LocalFrame | None:
    """The local frame that the chunk's coordinates are already in; None where they are not."""
    if transform.scale != 1.0:
        return None
    x, y, z = transform.translation.tolist()
    longitude, latitude, height = ECEF_FROM_GEODETIC.transform(x, y, z, direction="INVERSE")
    away = np.abs(transform.rotation - enu_axes(latitude, longitude)).max()
    if away > 1e-9 or abs(height) > 1e-4:
        return None
    return LocalFrame(float(latitude), float(longitude))


def _camera_of(path: Path, sensor: ET.Element) -> BlockCamera:
    label = sensor.attrib["label"]
    if sensor.attrib["type"] != "frame":
        raise BlockError(
            f"{path}: sensor {label} is of type {sensor.attrib['type']}; frame cameras are carried"
        )
    known = {one.attrib["class"]: one for one in sensor.iterfind("calibration")}
    calibration = known.get("adjusted", known.get("initial"))
    if calibration is None:
        raise BlockError(f"{path}: sensor {label} has no calibration")
    size = sensor.find("resolution")
    if size is None:
        raise BlockError(f"{path}: sensor {label} has no resolution")
    width, height = int(size.attrib["width"]), int(size.attrib["height"])
    values = {
        one.tag: float(one.text) for one in calibration if one.tag != "resolution" and one.text
    }
    strange = [f"{name} {value:g}" for name, value in values.items() if name not in _CARRIED]
    if {"fx", "fy"} & set(values):
        raise BlockError(
            f"{path}: sensor {label} has fx and fy, which PhotoScan before 1.2 wrote; export the "
            "cameras with a later version"
        )
    if any(values[name.split()[0]] != 0.0 for name in strange):
        raise BlockError(
            f"{path}: sensor {label} has {', '.join(strange)}; {', '.join(sorted(_CARRIED))} are "
            "carried. Optimize the cameras without these parameters"
        )
    if "f" not in values:
        raise BlockError(f"{path}: sensor {label} has no f")

    def value(name: str) -> float:
        return values.get(name, 0.0)

    model = ForwardDistortion(
        values["f"] + value("b1"),
        values["f"],
        value("cx") + (width - 1) / 2.0,
        value("cy") + (height - 1) / 2.0,
        skew_px=value("b2"),
        **{ours: value(theirs) for theirs, ours in TERMS.items()},
    )
    pitch = {p.attrib["name"]: p.attrib["value"] for p in sensor.iterfind("property")}
    pitch_mm = float(pitch["pixel_width"]) if "pixel_width" in pitch else None
    bands = tuple(band.attrib["label"].lower() for band in sensor.iterfind("bands/band"))
    return BlockCamera(label, width, height, model, pitch_mm, bands)


def _orthogonal(rotation: Array, what: str) -> None:
    if (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHOGONAL_TO
        or np.linalg.det(rotation) < 0.0
    ):
        raise BlockError(f"{what} is no rotation")


def _numbers(text: str, count: int) -> Array:
    values: Sequence[float] = [float(v) for v in text.split()]
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{text.strip()[:60]!r} where {count} finite numbers are needed")
    return np.array(values)
