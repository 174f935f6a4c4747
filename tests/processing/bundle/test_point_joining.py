"""Points of pairs of images that are one point get all its rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.bundle.adjust import Adjustment, adjust
from processing.bundle.network import Distances, ImagePoints, Network, Points
from processing.bundle.point_joining import joined_points, named_points
from tests.processing.bundle.simulated_networks import aerial


@pytest.fixture(scope="module")
def whole() -> Network:
    return aerial(seed=3, sigma_mm=1e-3, points=50).network


@pytest.fixture(scope="module")
def split(whole) -> Network:
    """Every tie point is another one in images 2 and 3 of each four: names with a prime."""
    table, points = whole.image_points, whole.points
    n = len(points.names)
    tie = ~named_points(whole)
    other = (table.image % 4 >= 2) & tie[table.point]
    return replace(
        whole,
        points=Points(
            (*points.names, *(f"{name}'" for name in points.names)),
            np.vstack([points.xyz_m, points.xyz_m]),
            np.vstack([points.sigma_m, np.full_like(points.sigma_m, np.nan)]),
            np.zeros(2 * n, dtype=bool),
        ),
        image_points=ImagePoints(
            table.image, np.where(other, table.point + n, table.point), table.xy_mm, table.sigma_mm
        ),
    )


def _joined(result: Adjustment) -> tuple[Network, int]:
    return joined_points(
        result.network, result.state.points, result.point_cofactor * result.sigma0**2
    )


def test_points_of_other_images_are_joined_and_the_result_is_that_of_whole_points(
    whole, split
) -> None:
    apart = adjust(split)
    network, count = _joined(apart)
    adjusted_twice = [k for k in range(50) if not apart.left_out[k] and not apart.left_out[k + 50]]
    assert count >= 0.95 * len(adjusted_twice) > 10
    assert len(network.points.names) == 100 - count
    rows = network.image_points
    names = np.array(network.points.names)[rows.point]
    before = np.array(split.points.names)[split.image_points.point]
    assert {(a, b.rstrip("'")) for a, b in zip(names, before, strict=True)} == {
        (a, a.rstrip("'")) for a in names
    }
    result, expected = adjust(network), adjust(whole)
    assert result.redundancy > apart.redundancy
    assert result.sigma0 == pytest.approx(expected.sigma0, rel=0.05)


def test_points_that_an_image_sees_both_are_two(whole) -> None:
    table = whole.image_points
    seen = [set(table.image[table.point == k]) for k in range(50)]
    first, second = next(
        (a, b) for a in range(10, 50) for b in range(a + 1, 50) if seen[a] & seen[b]
    )
    xyz = whole.points.xyz_m.copy()
    xyz[second] = xyz[first]
    covariance = np.tile(1e-6 * np.eye(3), (50, 1, 1))
    joined, count = joined_points(whole, xyz, covariance)
    assert count == 0
    assert joined is whole


def test_control_points_are_not_joined_with_each_other_and_keep_their_name(split) -> None:
    table = split.image_points
    xyz = split.points.xyz_m.copy()
    # p1 in images of its own, at the place of p0; p10' at that of p10, which is a check point.
    own = np.where(np.isin(table.image, (0, 1)), table.point, -1)
    keep = (table.point != 1) | (own == -1)
    keep &= (table.point != 0) | (own != -1)
    fewer = ImagePoints(
        table.image[keep], table.point[keep], table.xy_mm[keep], table.sigma_mm[keep]
    )
    xyz[1] = xyz[0]
    network = replace(split, image_points=fewer)
    covariance = np.tile(1e-6 * np.eye(3), (100, 1, 1))
    named = named_points(network, ("p10'",))
    assert named.sum() == named_points(network).sum() + 1
    joined, _ = joined_points(network, xyz, covariance, named)
    assert {"p0", "p1", "p10'"} <= set(joined.points.names)
    assert "p10" not in joined.points.names


def test_distances_end_at_the_joined_point(split) -> None:
    distances = Distances(np.array([60]), np.array([20]), np.array([100.0]), np.array([0.1]))
    joined, _ = joined_points(
        replace(split, distances=distances),
        split.points.xyz_m,
        np.tile(1e-6 * np.eye(3), (100, 1, 1)),
    )
    names = joined.points.names
    assert names[joined.distances.point_a[0]] in ("p10", "p10'")
    assert names[joined.distances.point_b[0]] == "p20"
