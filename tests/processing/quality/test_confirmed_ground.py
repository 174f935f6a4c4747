"""How much of a frame other heads confirm, from matches given by hand."""

from __future__ import annotations

import numpy as np
import pytest

from processing.matching.tie_points import PAN_TO_COLOUR, TiePoints
from processing.quality.confirmed_ground import confirmed_ground_figures
from processing.quality.figures.image import ConfirmedGroundFigures
from processing.rig import find_rig

RIG = find_rig("ultracam-l-mini")
PAN, GREEN = RIG.cone("0").sensors[0], RIG.cone(RIG.colour_master_cone or "").sensors[0]


def matches(columns: int, rows: int) -> TiePoints:
    """A point in each of so many of the 8 by 8 parts of PAN, all in one part of green."""
    c, r = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    at = np.stack([c.ravel() / 8 * PAN.width_px, r.ravel() / 8 * PAN.height_px], axis=1)
    n = len(at)
    return TiePoints(
        names=(PAN.name, GREEN.name),
        pairs=((PAN.name, GREEN.name),),
        attempted=(n,),
        sensor_a=np.zeros(n, np.int64),
        sensor_b=np.ones(n, np.int64),
        raw_a=at,
        raw_b=np.tile([[5.0, 5.0]], (n, 1)),
        sigma_px=np.ones(n),
        correlation=np.ones(n),
        kind=np.full(n, PAN_TO_COLOUR),
        overlap=np.zeros(n, np.int64),
    )


@pytest.mark.parametrize(("columns", "rows"), [(8, 8), (8, 4), (3, 5)])
def test_parts_with_a_match_are_confirmed(columns: int, rows: int) -> None:
    found = confirmed_ground_figures(RIG, [PAN.name], matches(columns, rows), [])
    assert found == ConfirmedGroundFigures(columns * rows / 64, PAN.name)


def test_the_frame_with_the_least_is_named() -> None:
    found = confirmed_ground_figures(RIG, [PAN.name, GREEN.name], matches(8, 8), [])
    assert found == ConfirmedGroundFigures(1 / 64, GREEN.name)
    other = confirmed_ground_figures(RIG, [PAN.name, "SU10"], matches(8, 8), [])
    assert other == ConfirmedGroundFigures(0.0, "SU10")
    assert confirmed_ground_figures(RIG, [], matches(1, 1), []) == ConfirmedGroundFigures()
