"""Covariances of an adjustment as a NumPy archive (npz)."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from daemon.mission.store.durable import new_file
from processing.bundle.adjust import Adjustment

_NAMES_BYTES = 200


def is_covariances(head: bytes) -> bool:
    """Whether a file that begins so was written by `write_covariances`."""
    return head.startswith(b"PK") and b"unknowns.npy" in head[:_NAMES_BYTES]


def write_covariances(path: Path, result: Adjustment) -> None:
    """Write the covariance matrix of the unknowns, and that of each object point.

    Arrays: `unknowns` (c,) names; `covariance` (c, c) of stations, attitudes, heads, cameras and
    lines, and of object points that have columns, in m, rad about the axes of camera or rig, mm and
    the units of additional parameters; `points` (p,) names; `point_covariance` (p, 3, 3) m squared,
    NaN for points left out; `sigma0`, by whose square cofactors were multiplied, 1 where the
    redundancy is 0.

    Args:
        path: the archive; its folder exists.
        result: the adjustment.
    """
    sigma0 = result.sigma0 if result.redundancy > 0 else 1.0
    content = BytesIO()
    np.savez_compressed(
        content,
        unknowns=np.array([u.name for u in result.layout.unknowns], dtype=np.str_),
        covariance=sigma0**2 * result.cofactor,
        points=np.array(result.network.points.names, dtype=np.str_),
        point_covariance=sigma0**2 * result.point_cofactor,
        sigma0=np.array(sigma0),
    )
    with new_file(path) as part:
        part.write_bytes(content.getbuffer())
