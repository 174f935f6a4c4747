"""What the project of an adjusted block holds, so that adjusting it again has the same result."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from daemon.postflight.adjustment.project_file import AdjustSection, ProjectFile
from processing.bundle.adjust import Adjustment, AdjustmentSettings
from processing.bundle.network import INTERIOR, Distances, ImagePoints, Network
from processing.bundle.unknowns import ParameterValues, initial_values


def with_settings(file: ProjectFile, settings: AdjustmentSettings) -> ProjectFile:
    """The project file with the settings that its adjustment had, options of the command included.

    Args:
        file: as read.
        settings: of the adjustment.

    Returns:
        A file whose section `adjust` has these settings.
    """
    names = {f.name for f in fields(settings)} & set(AdjustSection.model_fields)
    return file.model_copy(
        update={"adjust": file.adjust.model_copy(update={n: getattr(settings, n) for n in names})}
    )


def used_network(result: Adjustment) -> Network:
    """The network without the observations that the adjustment left out.

    Args:
        result: the adjustment.

    Returns:
        Image points and distances that were left out are not in it, such coordinates of control
        points are free, and such coordinates of GNSS positions and attitudes have an infinite
        sigma.
    """
    network = result.excluded.applied(result.network)
    table, distances, points = network.image_points, network.distances, network.points
    own, tied = ~result.excluded.image, ~result.excluded.distance[:, 0]
    return replace(
        network,
        image_points=ImagePoints(
            table.image[own], table.point[own], table.xy_mm[own], table.sigma_mm[own]
        ),
        distances=Distances(
            distances.point_a[tied],
            distances.point_b[tied],
            distances.distance_m[tied],
            distances.sigma_m[tied],
        ),
        points=replace(points, sigma_m=np.where(np.isinf(points.sigma_m), np.nan, points.sigma_m)),
    )


def initial_state(result: Adjustment) -> ParameterValues:
    """Values that a further adjustment begins with, and has the same result.

    What is observed with a prior standard deviation keeps the given value: it is the observation.
    With constraints next to such observations everything does, for constraints hold the sum of
    corrections of what is given.

    Args:
        result: the adjustment.

    Returns:
        Adjusted values of everything else.
    """
    network, given = result.network, initial_values(result.network)
    observed = any(camera.sigma for camera in network.cameras) or any(
        sigma is not None
        for head in network.heads
        for sigma in (
            *(head.rotation_sigma_rad, head.offset_sigma_m),
            *(head.timing.delay_sigma_s, head.timing.readout_sigma_s),
        )
    )
    if observed and (network.constraints or any(c.gauges for c in network.cameras)):
        return given
    state = result.state
    interior, terms = state.interior.copy(), [own.copy() for own in state.terms]
    for k, camera in enumerate(network.cameras):
        for at, name in enumerate(INTERIOR):
            if name in camera.sigma:
                interior[k, at] = given.interior[k, at]
        for at, term in enumerate(camera.terms):
            if term.name in camera.sigma:
                terms[k][at] = given.terms[k][at]
    rotation, offset = state.head_rotation.copy(), state.head_offset.copy()
    delay, readout = state.head_delay.copy(), state.readout.copy()
    for k, head in enumerate(network.heads):
        if head.timing.delay_sigma_s is not None:
            delay[k] = given.head_delay[k]
        if head.timing.readout_sigma_s is not None:
            readout[k] = given.readout[k]
        if head.rotation_sigma_rad is not None:
            rotation[k] = given.head_rotation[k]
        if head.offset_sigma_m is not None:
            offset[k] = given.head_offset[k]
    return replace(
        state,
        interior=interior,
        terms=tuple(terms),
        head_rotation=rotation,
        head_offset=offset,
        head_delay=delay,
        readout=readout,
    )
