"""Ground of oblique missions: a plateau as a height model, and where heads see points of it."""

from __future__ import annotations

from pathlib import Path

import pyproj

from sim_hw.world import true_camera

CRS = "EPSG:32633"


def hill(path: Path, here: tuple[float, float, float], top_m: float) -> Path:
    """A plateau so high above what was planned, as an ESRI ASCII grid."""
    to_grid = pyproj.Transformer.from_crs("EPSG:4979", CRS, always_xy=True)
    east, north, height = to_grid.transform(here[1], here[0], here[2])
    row = " ".join([f"{height + top_m:.3f}"] * 80)
    corner = f"xllcorner {east - 2000}\nyllcorner {north - 2000}\ncellsize 50\n"
    path.write_text(f"ncols 80\nnrows 80\n{corner}" + "\n".join([row] * 80))
    return path


def seen_pixels(world, rig, name, pose, ground):
    """Image, column and row in strict perspective where the true head sees a ground point."""
    cone = rig.cone(name.split("_")[1])
    rotation = (
        pose.enu_from_body @ true_camera.BODY_FROM_CAMERA @ world.camera.master_from_cone(cone)
    )
    seen = (ground - true_camera.projection_centre_m(cone, pose)) @ rotation
    x, y = -cone.lens.f_mm * seen[:2] / seen[2] / 7.2e-3
    column, row = x + (416 - 1) / 2, (278 - 1) / 2 - y
    inside = seen[2] < 0 and 3 < column < 412 and 3 < row < 274
    return (name, column, row) if inside else None
