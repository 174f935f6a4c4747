"""Size of one image and of its pixels on level ground, as planned: from the rig and a height
alone."""

from __future__ import annotations

from processing.rig import Rig


def image_on_ground_m(rig: Rig, height_above_ground_m: float) -> tuple[float, float]:
    """Along and across flight, of level ground, as planned: (along, across) metres."""
    virtual = rig.virtual_image
    if virtual is not None:
        scale = height_above_ground_m / virtual.f_mm
        return (
            virtual.height_px * virtual.pitch_mm * scale,
            virtual.width_px * virtual.pitch_mm * scale,
        )
    cone = rig.cone(rig.master_cone)
    sensor, scale = cone.sensors[0], height_above_ground_m / cone.lens.f_mm
    return sensor.height_px * sensor.pitch_mm * scale, sensor.width_px * sensor.pitch_mm * scale


def ground_pixel_m(rig: Rig, height_above_ground_m: float) -> float:
    """Ground sampling distance on level ground, as planned, m."""
    virtual = rig.virtual_image
    if virtual is not None:
        return virtual.pitch_mm * height_above_ground_m / virtual.f_mm
    cone = rig.cone(rig.master_cone)
    return cone.sensors[0].pitch_mm * height_above_ground_m / cone.lens.f_mm
