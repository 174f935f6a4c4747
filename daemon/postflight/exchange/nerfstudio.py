"""nerfstudio's `transforms.json`: cameras of OpenGL, which have our axes, in metres of the frame.

Source: nerfstudio documentation, "Data conventions"; pixel centres are at 0.5.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from daemon.postflight.exchange.block import Block, fitted
from daemon.postflight.exchange.colmap import CENTRE_PX


def nerfstudio_texts(
    block: Block, folder: str, suffix: str
) -> tuple[dict[str, str], dict[str, float]]:
    """`transforms.json`, one entry an image with its own intrinsics.

    Args:
        folder: of the images, from the file.
        suffix: of the image files' names.

    Returns:
        Texts by file name, and the largest residual of each camera's fit by its name, px.

    Raises:
        BlockError: a camera does not fit.
    """
    models, residuals = [], {}
    for camera in block.cameras:
        _, model, residuals[camera.name] = fitted(camera, ("pinhole", "opencv", "brown"))
        models.append(model)
    frames: list[dict[str, Any]] = []
    for image in block.images:
        camera, model = block.cameras[image.camera], models[image.camera]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = image.rotation, image.centre_m
        frames.append(
            {
                "file_path": f"{folder}/{image.name}{suffix}",
                "w": camera.width_px,
                "h": camera.height_px,
                "fl_x": model.fx_px,
                "fl_y": model.fy_px,
                "cx": model.cx_px + CENTRE_PX,
                "cy": model.cy_px + CENTRE_PX,
                **{key: getattr(model, key) for key in ("k1", "k2", "k3", "p1", "p2")},
                "transform_matrix": pose.tolist(),
            }
        )
    content = {"camera_model": "OPENCV", "frames": frames}
    return {"transforms.json": json.dumps(content, indent=1) + "\n"}, residuals
