"""Starting values of a block of which no image has an orientation, and few see known points.

Where `initial_values` finds no image to begin with, the images are oriented relative to each other
and brought to the control points or antenna positions by a similarity.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.camera_model import ideal_mm, principal_distance_mm
from processing.bundle.incremental_orientation import PhotographTracks, orient_photographs
from processing.bundle.initial_values import completed
from processing.bundle.network import CameraModel, Network, NetworkError
from processing.geometry.positions_fit import NotPlacedError, fit_positions

Array = NDArray[np.float64]

_ESTIMATED: Final = ("df", "k1", "k2")
"""Parameters whose neglect would keep images from fitting."""

_PIXELS_PER_F: Final = 5000.0
"""Where a camera states no pixel."""

_MIN_KNOWN: Final = 3
_CONTRADICTION: Final = 0.05
"""Residual of the similarity over the extent of the known places."""


def starting_values(network: Network) -> Network:
    """Fill in what has no starting value (NaN), of a block without any orientation, too.

    Args:
        network: observations; stations, attitudes and points may be NaN.

    Returns:
        The network with starting values; without known points or antenna positions in a frame
        without scale.

    Raises:
        NetworkError: images that neither resection nor relative orientation reaches, or known
            places that do not fit the block.

    Source: docs/explanation/mathematics/bundle.md#orientation-without-attitudes.
    """
    try:
        return completed(network)
    except NetworkError:
        oriented = relatively_oriented(network)
        if oriented is None:
            raise
        return completed(oriented)


def relatively_oriented(network: Network) -> Network | None:
    """Orient the images relative to each other and bring them to known places.

    Args:
        network: observations without orientation of an image that has image points.

    Returns:
        The network with orientations of the images that hang together; None where images have
        orientations or heads, or where no two images have enough points in common.

    Raises:
        NetworkError: known places that do not fit the block.
    """
    table, images = network.image_points, network.images
    placed = np.isfinite(network.stations.position_m[images.station]).all(axis=1)
    turned = np.isfinite(network.attitudes.rotation[images.attitude]).all(axis=(1, 2))
    given = np.asarray(placed & turned)
    rows = np.flatnonzero(~network.points.at_infinity[table.point])
    if given[np.unique(table.image)].any() or (images.head >= 0).any() or not rows.size:
        return None
    ideal = np.empty_like(table.xy_mm)
    for index, camera in enumerate(network.cameras):
        own = images.camera[table.image] == index
        terms = np.array([term.value for term in camera.terms])
        ideal[own] = ideal_mm(camera, camera.interior, terms, table.xy_mm[own])
    tracks = PhotographTracks(
        table.image[rows],
        table.point[rows],
        ideal[rows],
        len(images.names),
        len(network.points.names),
        images.camera,
    )
    estimated = frozenset(_ESTIMATED) if any(c.free for c in network.cameras) else frozenset()
    block = orient_photographs([_plain(c, estimated) for c in network.cameras], tracks)
    if block is None:
        return None
    known = np.isfinite(network.points.xyz_m).all(axis=1) & ~network.points.at_infinity
    seen = np.flatnonzero(known & np.isfinite(block.xyz).all(axis=1))
    model, place = block.xyz[seen], network.points.xyz_m[seen]
    if len(seen) < _MIN_KNOWN and len(network.gnss.station):
        station = np.full((len(network.stations.names), 3), np.nan)
        station[images.station] = block.station
        model, place = station[network.gnss.station], network.gnss.position_m
        there = np.isfinite(model).all(axis=1)
        model, place = model[there], place[there]
    scale, rotation, shift = 1.0, np.eye(3), np.zeros(3)
    if known.any() or len(network.gnss.station):
        try:
            fit = fit_positions(model, place)
        except NotPlacedError:
            return None
        scale, rotation, shift = fit.scale, fit.rotation, fit.shift
        _refuse_contradiction(place, fit.residual_m)
    position, attitude = network.stations.position_m.copy(), network.attitudes.rotation.copy()
    own = np.flatnonzero(block.oriented)
    position[images.station[own]] = scale * block.station[own] @ rotation.T + shift
    attitude[images.attitude[own]] = rotation @ block.rotation[own]
    return replace(
        network,
        stations=replace(network.stations, position_m=position),
        attitudes=replace(network.attitudes, rotation=attitude),
    )


def _refuse_contradiction(place: Array, residual_m: Array) -> None:
    """Refuse known places that have another shape than the block."""
    extent = float(np.linalg.norm(place - place.mean(axis=0), axis=1).max())
    away = np.linalg.norm(residual_m, axis=1)
    if float(np.median(away)) > _CONTRADICTION * extent:
        raise NetworkError(
            [
                f"the {len(place)} known places do not fit the shape of the block: half of them "
                f"are {np.median(away):.3g} m or more away; coordinates or names are wrong"
            ]
        )


def _plain(camera: CameraModel, estimated: frozenset[str]) -> CameraModel:
    """A camera of ideal image coordinates, whose interior is known to a tenth at its edge."""
    f = principal_distance_mm(camera, camera.interior)
    sigma = {"df": 0.1 * f, "k1": 0.4 / f**2, "k2": 1.6 / f**4}
    pixel = camera.pixel_mm or f / _PIXELS_PER_F
    return CameraModel(
        camera.name,
        f,
        free=estimated,
        sigma={name: sigma[name] for name in estimated},
        pixel_mm=pixel,
    )
