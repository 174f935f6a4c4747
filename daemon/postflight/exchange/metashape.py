"""Metashape's camera file (`cameras.xml`): sensors, rig, cameras, reference of one component.

Chunk coordinates are those of the local frame, and the component's transformation carries them to
the earth's centre. Axes are those of computer vision; principal points count from the image's
middle. `daemon.postflight.exchange.metashape_reader` reads such files.

Source: Agisoft Metashape User Manual, Professional Edition, version 2.1, appendix D "Camera
models", and the files that its "Export Cameras" writes.
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from daemon.orientation.geodesy import CRS, ECEF_FROM_GEODETIC, GEOGRAPHIC
from daemon.orientation.local_frame import LocalFrame, enu_axes
from daemon.postflight.exchange.block import (
    VISION_FROM_CAMERA,
    Block,
    BlockCamera,
    BlockError,
    BlockImage,
    BlockRig,
    fitted,
)
from daemon.postflight.exchange.opensfm import yaw_pitch_roll_deg
from daemon.postflight.export.picture_files import left_out_of_jpeg
from processing.geometry.forward_distortion import ForwardDistortion

Array = NDArray[np.float64]

VERSION = "2.0.0"
COMPONENT = "0"
TERMS = {
    "k1": "k1", "k2": "k2", "k3": "k3", "k4": "radial_r8", "p1": "p2", "p2": "p1",
}  # fmt: skip
"""Metashape's coefficients by name, and ours: its P1 acts along x, ours along y."""


def metashape_texts(
    block: Block, rig: BlockRig | None, suffix: str
) -> tuple[dict[str, str], dict[str, float]]:
    """`cameras.xml` of one chunk.

    Args:
        block: in a known local frame, its images as the rig has them.
        rig: None writes every camera as a sensor of its own.
        suffix: of the image files' names.

    Returns:
        Texts by file name, and the largest residual of each camera's fit by its name, px.

    Raises:
        BlockError: a camera does not fit, or the frame is not known.
    """
    if block.frame is None:
        raise BlockError("Metashape's chunk lies on the earth; the frame of this block is unknown")
    root = ET.Element("document", version=VERSION)
    chunk = ET.SubElement(root, "chunk", label=block.name, enabled="true")
    sensors = ET.SubElement(chunk, "sensors", next_id=str(len(block.cameras)))
    residuals = {}
    for number, camera in enumerate(block.cameras):
        _, model, residuals[camera.name] = fitted(camera, ("pinhole", "metashape"))
        _sensor(sensors, number, camera, model, rig)
    _component(chunk, block, block.frame)
    cameras = ET.SubElement(chunk, "cameras", next_id=str(len(block.images)), next_group_id="0")
    masters = _masters(block, rig)
    for number, image in enumerate(block.images):
        _camera(cameras, number, image, masters[number], suffix)
    reference = ET.SubElement(chunk, "reference")
    reference.text = CRS(GEOGRAPHIC).to_wkt("WKT1_GDAL")
    ET.indent(root)
    text = '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
    return {"cameras.xml": text}, residuals


def _sensor(
    parent: ET.Element,
    number: int,
    camera: BlockCamera,
    model: ForwardDistortion,
    rig: BlockRig | None,
) -> None:
    attributes = {"id": str(number), "label": camera.name, "type": "frame"}
    is_slave = rig is not None and number != rig.reference
    if rig is not None and is_slave:
        attributes["master_id"] = str(rig.reference)
    sensor = ET.SubElement(parent, "sensor", attributes)
    size = {"width": str(camera.width_px), "height": str(camera.height_px)}
    ET.SubElement(sensor, "resolution", size)
    if camera.pitch_mm is not None:
        for name in ("pixel_width", "pixel_height"):
            ET.SubElement(sensor, "property", name=name, value=repr(camera.pitch_mm))
        focal = repr(model.fy_px * camera.pitch_mm)
        ET.SubElement(sensor, "property", name="focal_length", value=focal)
    ET.SubElement(sensor, "property", name="layer_index", value=str(number if rig else 0))
    bands = ET.SubElement(sensor, "bands")
    # The images are JPEG, which has three bands.
    missing = left_out_of_jpeg(camera.bands)
    for band in (band for band in camera.bands if band not in missing):
        ET.SubElement(bands, "band", label=band.capitalize())
    ET.SubElement(sensor, "data_type").text = "uint8"
    calibration = ET.SubElement(sensor, "calibration", {"type": "frame", "class": "initial"})
    ET.SubElement(calibration, "resolution", size)
    values = {
        "f": model.fy_px,
        "cx": model.cx_px - (camera.width_px - 1) / 2.0,
        "cy": model.cy_px - (camera.height_px - 1) / 2.0,
        "b1": model.fx_px - model.fy_px,
        "b2": model.skew_px,
        **{theirs: getattr(model, ours) for theirs, ours in TERMS.items()},
    }
    for name, value in values.items():
        ET.SubElement(calibration, name).text = repr(value)
    if rig is not None and is_slave:
        turn = VISION_FROM_CAMERA @ rig.rotation[number] @ VISION_FROM_CAMERA
        ET.SubElement(sensor, "rotation", locked="true").text = _text(turn)
        place = VISION_FROM_CAMERA @ rig.offset_m[number]
        ET.SubElement(sensor, "translation", locked="true").text = _text(place)


def _masters(block: Block, rig: BlockRig | None) -> list[int | None]:
    """The number of each image's master image; None for masters."""
    if rig is None:
        return [None] * len(block.images)
    of_frame = {
        image.frame: number
        for number, image in enumerate(block.images)
        if image.camera == rig.reference
    }
    masters: list[int | None] = []
    for image in block.images:
        if image.camera != rig.reference and image.frame not in of_frame:
            raise BlockError(
                f"image {image.name} has no image of {block.cameras[rig.reference].name} in its "
                "exposure, which a rig of Metashape requires; use --rig no"
            )
        masters.append(None if image.camera == rig.reference else of_frame[image.frame])
    return masters


def _camera(
    parent: ET.Element, number: int, image: BlockImage, master: int | None, suffix: str
) -> None:
    attributes = {
        "id": str(number),
        "sensor_id": str(image.camera),
        "component_id": COMPONENT,
        "label": image.name + suffix,
    }
    if master is not None:
        attributes["master_id"] = str(master)
    camera = ET.SubElement(parent, "camera", attributes | {"enabled": "true"})
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = image.rotation @ VISION_FROM_CAMERA, image.centre_m
    ET.SubElement(camera, "transform").text = _text(pose)
    ET.SubElement(camera, "orientation").text = "1"
    if image.eo is None:
        return
    yaw, pitch, roll = yaw_pitch_roll_deg(image.eo.enu_from_camera)
    reference = {
        "x": f"{image.eo.longitude_deg:.10f}",
        "y": f"{image.eo.latitude_deg:.10f}",
        "z": f"{image.eo.height_m:.4f}",
        "yaw": f"{yaw:.7f}",
        "pitch": f"{pitch:.7f}",
        "roll": f"{roll:.7f}",
    }
    if image.sigma_m is not None:
        reference["sxyz"] = "/".join(f"{v:g}" for v in image.sigma_m)
    flags = {"enabled": "true", "rotation_enabled": "true"}
    ET.SubElement(camera, "reference", reference | flags)


def _component(chunk: ET.Element, block: Block, frame: LocalFrame) -> None:
    components = ET.SubElement(chunk, "components", next_id="1", active_id=COMPONENT)
    component = ET.SubElement(components, "component", id=COMPONENT, label="Component 1")
    transform = ET.SubElement(component, "transform")
    axes = enu_axes(frame.latitude_deg, frame.longitude_deg)
    origin = ECEF_FROM_GEODETIC.transform(frame.longitude_deg, frame.latitude_deg, 0.0)
    ET.SubElement(transform, "rotation", locked="true").text = _text(axes)
    ET.SubElement(transform, "translation", locked="true").text = _text(np.array(origin))
    ET.SubElement(transform, "scale", locked="true").text = "1.0"
    partition = ET.SubElement(component, "partition")
    numbers = " ".join(str(number) for number in range(len(block.images)))
    ET.SubElement(partition, "camera_ids").text = numbers


def _text(values: Array) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values).ravel())
