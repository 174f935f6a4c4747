"""Heads of an exposure as one rigid body: its orientation from any head, and their places in it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from daemon.postflight.triangulation.head_arrangement import HeadArrangement, arrangement_of
from processing.bundle.flown_network import MeasuredOrientations, MountingPrior, flown_exposures
from processing.geometry.orientation import BODY_FROM_CAMERA
from processing.geometry.rotation import rotation_matrix, rotations_from_vectors
from processing.rig import load_rig, shipped_rigs

HEADS = ("8", "5", "nadir")
APART_NS = 200_000


def _arranged(apart_ns: int) -> tuple[HeadArrangement, np.ndarray, np.ndarray, list, list]:
    """Three exposures of three heads; the first head is absent in the second exposure."""
    rig = load_rig(shipped_rigs()["midas-mini"])
    random = np.random.default_rng(4)
    platform = rotations_from_vectors(random.normal(0.0, 0.5, (3, 3)))
    place = random.normal(0.0, 500.0, (3, 3))
    images, stations, rotations = [], [], []
    for k in range(3):
        for h, name in enumerate(HEADS):
            if k == 1 and h == 0:
                continue
            cone = rig.cone(name)
            body = platform[k] @ BODY_FROM_CAMERA.T
            lever_mm = np.array(cone.position_mm) - np.array(rig.cone(HEADS[0]).position_mm)
            stations.append(place[k] + body @ lever_mm * 1e-3)
            rotations.append(body @ BODY_FROM_CAMERA @ rotation_matrix(*cone.rotation_rad))
            images.append(
                SimpleNamespace(
                    exposure=k + 1, cone=name, is_virtual=False, name=f"{k + 1:06d}_{name}",
                    gps_ns=k * 10**9 + h * apart_ns,
                )
            )  # fmt: skip
    found = arrangement_of(rig, images, np.array(stations), np.array(rotations))
    return found, place, platform, stations, rotations


def test_heads_that_expose_together_are_one_rigid_body() -> None:
    found, place, platform, stations, rotations = _arranged(0)
    assert found.names == ("000001", "000002", "000003")
    assert [one.name for one in found.heads] == list(HEADS)
    assert found.position_m == pytest.approx(place, abs=1e-9)
    assert found.rotation == pytest.approx(platform, abs=1e-12)
    for k, (station, rotation) in enumerate(zip(stations, rotations, strict=True)):
        e, head = found.exposure[k], found.heads[found.head[k]]
        assert found.position_m[e] + found.rotation[e] @ head.offset_m == pytest.approx(station)
        assert found.rotation[e] @ head.rotation == pytest.approx(rotation, abs=1e-12)
    sigma = np.ones((3, 3))
    measured = MeasuredOrientations(found.position_m, found.rotation, sigma, sigma)
    flown = flown_exposures(found.names, measured, MountingPrior(1e-4, 0.02), heads=found.heads)
    assert [one.name for one in flown.heads] == list(HEADS)
    assert all(one.rotation_free and one.rotation_sigma_rad == 1e-4 for one in flown.heads)
    held = flown_exposures(found.names, measured, None, heads=found.heads)
    assert not any(one.rotation_free or one.offset_free for one in held.heads)
    assert flown_exposures(found.names, measured, None).heads == ()


def test_heads_at_different_instants_share_their_mountings_only() -> None:
    found, *_ = _arranged(APART_NS)
    assert len(found.names) == 8 and found.exposure.tolist() == list(range(8))
    assert found.head.tolist() == [0, 1, 2, 1, 2, 0, 1, 2]
