"""Images that no object point connects with the others: blocks of their own in one project."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from processing.bundle.network import Network

Indices = NDArray[np.int64]

_MAX_NAMED: Final = 5
_MIN_KNOWN: Final = 3
"""Control points or antenna positions that hold a block."""


def separate_blocks(network: Network) -> list[Indices]:
    """Groups of images that object points, exposures or distances connect.

    Args:
        network: observations; images without image points are in no group.

    Returns:
        Images of each group, the largest group first.
    """
    table, images = network.image_points, network.images
    n, p = len(images.names), len(network.points.names)
    finite = np.flatnonzero(~network.points.at_infinity[table.point])
    distances = network.distances
    first = [table.image[finite], np.arange(n), np.arange(n), n + distances.point_a]
    second = [
        n + table.point[finite],
        n + p + images.station,
        n + p + len(network.stations.names) + images.attitude,
        n + distances.point_b,
    ]
    size = n + p + len(network.stations.names) + len(network.attitudes.names)
    ends = np.concatenate(first), np.concatenate(second)
    graph = sparse.coo_array((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(size, size))
    label = sparse.csgraph.connected_components(graph, directed=False)[1]
    seen = np.unique(table.image)
    groups = [seen[label[seen] == one] for one in np.unique(label[seen])]
    return sorted(groups, key=lambda group: -len(group))


def unplaced_blocks(network: Network) -> list[str]:
    """Name the blocks that nothing places where there are several.

    Args:
        network: observations.

    Returns:
        A sentence for each block without control, antenna positions or held orientations.
    """
    groups = separate_blocks(network)
    if len(groups) < 2:
        return []
    table = network.image_points
    control = np.asarray((np.nan_to_num(network.points.sigma_m, nan=-1.0) >= 0.0).any(axis=1))
    found = []
    for group in groups:
        own = np.isin(table.image, group)
        known = int(control[np.unique(table.point[own])].sum())
        station = network.images.station[group]
        known += len(np.unique(network.gnss.station[np.isin(network.gnss.station, station)]))
        held = network.stations.fixed[station].any()
        if known >= _MIN_KNOWN or held:
            continue
        names = [network.images.names[k] for k in group[:_MAX_NAMED]]
        more = ", ..." if len(group) > _MAX_NAMED else ""
        found.append(
            f"{len(group)} of {len(np.unique(table.image))} images ({', '.join(names)}{more}) have "
            "no object point in common with the others, and less than three control points or "
            "GNSS positions of their own: measure points that connect them, or adjust them on "
            "their own"
        )
    return found
