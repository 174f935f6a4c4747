"""Overlap of an exposure with earlier ones: the one before it, and the neighbouring line.

Footprints on level ground, without the parts of heads that sent no image; the band with the least
overlap counts. Relief is left out. An exposure is compared with those of smaller
numbers only, so that the figures are the same whenever it is processed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import MountSection
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import mount_of, sealed_exposures
from daemon.orientation.footprints import footprint_corners
from daemon.planning.image_counts import Flags, gaps_of, image_shares, is_inside
from daemon.planning.model import LocalPlane, Point
from processing.quality.nominal_area import nominal_area
from processing.quality.valid_area import ValidArea
from processing.rig import Rig

SAMPLES = 41
"""Of a footprint, along and across: overlaps are good to a few hundredths."""

BEFORE = 3
"""Search depth, in numbers, for the previous image on the line."""

NEIGHBOUR_WIDTHS = (0.1, 1.3)
"""Across-track distance of an image of a neighbouring line, in widths of this image."""

PARALLEL_RAD = math.radians(30.0)
MIN_ROW_SHARE = 0.5
"""A neighbouring line flown next to less than half of this image is not evaluated."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OverlapShares:
    """Shares of an exposure's footprint; None where there is nothing to compare with."""

    forward_overlap: float | None = None
    sidelap: float | None = None


@dataclass(frozen=True)
class _FlownFootprint:
    """`corners` (4, 2) in metres: left and right behind, right and left ahead."""

    number: int
    line_id: str
    corners: Array
    centre: Array
    ahead: Array
    area: ValidArea


class Overlaps:
    """The footprints of a flight over planned lines.

    Args:
        rig, mount: the camera, and how it sits.
        ground_height_m: above the ellipsoid.
    """

    def __init__(self, rig: Rig, mount: MountSection, ground_height_m: float) -> None:
        self._rig, self._mount, self._ground_m = rig, mount, ground_height_m
        self._plane: LocalPlane | None = None
        self._seen: dict[int, _FlownFootprint] = {}

    def add(self, exposure: Exposure) -> None:
        """Take in an exposure; one without line, position or attitude is passed over."""
        if not exposure.line_id or exposure.navigation is None:
            return
        corners = footprint_corners(self._rig, self._mount, exposure.navigation, self._ground_m)
        if corners is None:
            return
        places = [Point(latitude, longitude) for longitude, latitude in corners]
        self._plane = self._plane or LocalPlane(places[0])
        flat = np.array([self._plane.flat(place) for place in places])
        ahead = flat[2] + flat[3] - flat[0] - flat[1]
        self._seen[exposure.number] = _FlownFootprint(
            exposure.number,
            exposure.line_id,
            flat,
            flat.mean(axis=0),
            ahead / max(float(np.hypot(*ahead)), 1e-9),
            nominal_area(self._rig, [sensor for sensor, _ in exposure.missing]),
        )

    def of(self, number: int) -> OverlapShares:
        """Data of an exposure that was added."""
        this = self._seen.get(number)
        if this is None:
            return OverlapShares()
        before = (self._seen.get(number - back) for back in range(1, BEFORE + 1))
        last = next((one for one in before if one and one.line_id == this.line_id), None)
        forward = None if last is None else _share(this, _samples(this.corners), [last])
        return OverlapShares(forward, self._sidelap(this))

    def _sidelap(self, this: _FlownFootprint) -> float | None:
        """The share seen by the nearest line on either side, the poorer of the two."""
        right = np.array([this.ahead[1], -this.ahead[0]])
        width_m = float(np.ptp(this.corners @ right))
        reach_m = 2.0 * float(np.max(np.ptp(this.corners, axis=0)))
        near, far = (share * width_m for share in NEIGHBOUR_WIDTHS)
        sides: dict[tuple[bool, str], list[_FlownFootprint]] = {}
        for other in self._seen.values():
            if other.number >= this.number or other.line_id == this.line_id:
                continue
            offset_m = other.centre - this.centre
            if np.abs(offset_m).max() > reach_m:
                continue
            across_m = float(offset_m @ right)
            is_parallel = abs(float(other.ahead @ this.ahead)) > math.cos(PARALLEL_RAD)
            if is_parallel and near < abs(across_m) < far:
                sides.setdefault((across_m > 0, other.line_id), []).append(other)
        found: dict[bool, tuple[float, float]] = {}
        for (is_right, _), images in sides.items():
            across_m = float(np.mean([abs((o.centre - this.centre) @ right) for o in images]))
            share = self._share_seen_by_line(this, images)
            nearest = found.get(is_right)
            if share is not None and (nearest is None or across_m < nearest[0]):
                found[is_right] = (across_m, share)
        return min((share for _, share in found.values()), default=None)

    def _share_seen_by_line(
        self, this: _FlownFootprint, images: Sequence[_FlownFootprint]
    ) -> float | None:
        """Share of this image that a line saw, over the rows the line has been flown next to."""
        samples = _samples(this.corners)
        reaches = np.concatenate([image.corners @ this.ahead for image in images])
        rows = samples.mean(axis=1) @ this.ahead
        flown = (rows >= reaches.min()) & (rows <= reaches.max())
        return _share(this, samples[flown], images) if flown.mean() >= MIN_ROW_SHARE else None


def overlaps_of(
    mission: Mission, rig: Rig, exposures: Iterable[Exposure] | None = None
) -> Overlaps:
    """The footprints of what has been flown of a mission.

    Args:
        exposures: None takes all sealed records that can be read.
    """
    mount, plan = mount_of(mission)
    overlaps = Overlaps(rig, mount, plan.ground_height_m)
    if exposures is None:
        # Verification names what cannot be read; no flight is given up for an overlap.
        exposures = sealed_exposures(mission).results.values()
    for exposure in exposures:
        overlaps.add(exposure)
    return overlaps


def _samples(corners: Array) -> Array:
    """Points spread evenly over a quadrilateral, (rows ahead, columns, 2)."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    across = steps[None, :, None]
    behind = corners[0] + across * (corners[1] - corners[0])
    ahead = corners[3] + across * (corners[2] - corners[3])
    return np.asarray(behind + steps[:, None, None] * (ahead - behind))


def _share(this: _FlownFootprint, samples: Array, images: Sequence[_FlownFootprint]) -> float:
    """The share of the samples of an image that it sees itself and one of the others does, too."""
    bands = {band for one in (this, *images) for band in one.area.gaps}
    shares = []
    for band in bands or {""}:
        others = np.logical_or.reduce([_visible(one, samples, band) for one in images])
        shares.append(float((_visible(this, samples, band) & others).mean()))
    return min(shares)


def _visible(image: _FlownFootprint, samples: Array, band: str) -> Flags:
    at = image_shares(image.corners, samples)
    inside = is_inside(at)
    gaps = gaps_of(image.area, at, inside).get(band)
    return inside if gaps is None else inside & ~gaps
