"""COLMAP's database with cameras, rigs, frames, images and position priors, through pycolmap."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from daemon.postflight.exchange.block import Block, BlockRig, fitted
from daemon.postflight.exchange.colmap import (
    FORMS,
    MODEL_OF_FORM,
    frame_groups,
    model_parameters,
    rig_pose,
)
from drivers.base.extras import require
from processing.geometry.rotation import quaternions_from_rotations


def write_database(path: Path, block: Block, rig: BlockRig | None) -> int:
    """Write a new database; the number of images with a position prior and its covariance.

    Raises:
        MissingExtraError: pycolmap is not installed.
        BlockError: a camera fits none of COLMAP's models.
    """
    require("colmap")
    import pycolmap

    with_prior = 0
    with pycolmap.Database.open(str(path)) as database:
        for number, camera in enumerate(block.cameras, 1):
            form, model, _ = fitted(camera, FORMS)
            database.write_camera(
                pycolmap.Camera(
                    camera_id=number,
                    model=MODEL_OF_FORM[form],
                    width=camera.width_px,
                    height=camera.height_px,
                    params=model_parameters(MODEL_OF_FORM[form], model),
                    has_prior_focal_length=True,
                ),
                use_camera_id=True,
            )
        for one in _rigs(pycolmap, block, rig):
            database.write_rig(one, use_rig_id=True)
        for number, image in enumerate(block.images, 1):
            database.write_image(
                pycolmap.Image(name=image.name, camera_id=image.camera + 1, image_id=number),
                use_image_id=True,
            )
        groups = frame_groups(block, rig)
        for number, (of_rig, members) in enumerate(groups, 1):
            frame = pycolmap.Frame(frame_id=number, rig_id=of_rig + 1)
            for k in members:
                frame.add_data_id(_data_id(pycolmap, block.images[k].camera + 1, k + 1))
            database.write_frame(frame, use_frame_id=True)
        for k in sorted(_prior_image(block, rig, members) for _, members in groups):
            image, prior = block.images[k], pycolmap.PosePrior()
            prior.corr_data_id = _data_id(pycolmap, image.camera + 1, k + 1)
            prior.position = image.centre_m
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            if image.sigma_m is not None:
                prior.position_covariance = np.diag(np.square(image.sigma_m))
                with_prior += 1
            database.write_pose_prior(prior)
    return with_prior


def _prior_image(block: Block, rig: BlockRig | None, members: Sequence[int]) -> int:
    """The image that carries a frame's prior: a position is measured once, not once per head."""
    of_reference = (
        k for k in members if rig is not None and block.images[k].camera == rig.reference
    )
    return next(of_reference, members[0])


def _data_id(pycolmap: Any, camera: int, image: int) -> Any:
    return pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera), image)


def _rigs(pycolmap: Any, block: Block, rig: BlockRig | None) -> list[Any]:
    def sensor(camera: int) -> Any:
        return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera + 1)

    if rig is None:
        rigs = []
        for camera in range(len(block.cameras)):
            own = pycolmap.Rig(rig_id=camera + 1)
            own.add_ref_sensor(sensor(camera))
            rigs.append(own)
        return rigs
    one = pycolmap.Rig(rig_id=1)
    one.add_ref_sensor(sensor(rig.reference))
    for camera in rig.rotation:
        if camera != rig.reference:
            turn, shift = rig_pose(rig, camera)
            w, x, y, z = quaternions_from_rotations(turn).tolist()
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), shift)
            one.add_sensor(sensor(camera), pose)
    return [one]
