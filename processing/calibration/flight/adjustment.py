"""Lenses, relative orientation of heads and orientation of a flight, by one bundle adjustment.

An exposure has one projection centre and one rotation; heads are mountings against the reference
head. What a lens is beforehand is an observation, so that what the flight does not separate keeps
the standard deviation it had.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.adjustment_results import image_residuals_mm
from processing.bundle.network import (
    INTERIOR,
    Attitudes,
    Gnss,
    HeadMounting,
    ImagePoints,
    Images,
    Network,
    NetworkError,
    Points,
    Stations,
)
from processing.bundle.rank_diagnosis import RankDefectError
from processing.calibration.adjusted_heads import with_adjusted_heads
from processing.calibration.board.network import started, with_lens
from processing.calibration.flight.images import (
    FlightCalibrationError,
    FlightImages,
    camera_of,
    corner_mm,
    prior_sigmas,
)
from processing.calibration.flight.start import FlightStart, image_points_mm, start_of
from processing.geometry.rotation import rotation_matrix
from processing.matching.photograph_tracks import Tracks, spread_tracks
from processing.rig import Cone, Rig

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Progress = Callable[[str, int, int], None]

TIE_SIGMA_PX: Final = 0.5
OFFSET_SIGMA_M: Final = 0.01
"""Standard deviation of the projection centres of heads in the rig file."""
_REJECT_BEYOND: Final = 4.0
_MAX_ROUNDS: Final = 12
_MAX_SCALINGS: Final = 8
_LEFT_OUT_SHARE: Final = 0.1
_LEAST_REDUNDANCY: Final = 0.3
_SCALED_SHARE: Final = 0.03
_UNIT_PX: Final = 1000


@dataclass(frozen=True)
class FlightCalibration:
    """Result.

    Attributes:
        rig: with new lenses, sensor places and mountings.
        before: the rig flown with.
        heads: names of the heads with a new lens, the reference first.
        reference: name of the head that the others are oriented against.
        adjustment: with all its statistics.
        exposures: number of exposures that were adjusted.
        common: points that images of two heads share, by pair of names.
        left_out: sentences on heads that were not used.
    """

    rig: Rig
    before: Rig
    heads: tuple[str, ...]
    reference: str
    adjustment: Adjustment
    exposures: int
    common: Mapping[tuple[str, str], int]
    left_out: tuple[str, ...]

    @property
    def oriented_heads(self) -> tuple[str, ...]:
        """Heads that are oriented relative to the reference."""
        return self.heads[1:]

    @property
    def variance_factor(self) -> float:
        """What cofactors are multiplied with."""
        return max(1.0, self.adjustment.sigma0) ** 2

    @property
    def sigma_px(self) -> float:
        """Standard deviation of a coordinate of an image point, as the residuals show it."""
        table = self.adjustment.network.image_points
        pitch = np.array([self.rig.cone(name).sensors[0].pitch_mm for name in self.heads])
        used = np.isfinite(image_residuals_mm(self.adjustment)).all(axis=1)
        used &= self.adjustment.weight > 0.0
        camera = self.adjustment.network.images.camera[table.image]
        size = (table.sigma_mm / pitch[camera][:, None])[used]
        return float(np.sqrt(np.mean(size**2)))

    def sigmas(self, head: str) -> dict[str, float]:
        """Standard deviations of the interior orientation of a head.

        Args:
            head: its name.

        Returns:
            By parameter, mm and powers of it.
        """
        columns = self._interior_columns(head)
        variance = self.variance_factor * np.diag(self.adjustment.cofactor)
        return {name: math.sqrt(float(variance[k])) for name, k in columns.items()}

    def shares_of_prior(self, head: str) -> dict[str, float]:
        """Standard deviations over those beforehand; near one, the flight contributes nothing.

        Args:
            head: its name.

        Returns:
            By parameter.
        """
        prior = prior_sigmas(self.before.cone(head))
        return {name: sigma / prior[name] for name, sigma in self.sigmas(head).items()}

    def distortion_sigma_px(self, head: str) -> float:
        """Standard deviation of the correction of the lens at a corner.

        Args:
            head: its name.

        Returns:
            Pixels.
        """
        cone = self.rig.cone(head)
        r = corner_mm(cone)
        sensor = cone.sensors[0]
        x, y = 0.5 * sensor.width_px * sensor.pitch_mm, 0.5 * sensor.height_px * sensor.pitch_mm
        columns = self._interior_columns(head)
        # A part linear in the radius is a principal distance; it is taken out at 2/3 of the corner.
        radial = {"k1": r**3 - r * (2 * r / 3) ** 2, "k2": r**5 - r * (2 * r / 3) ** 4}
        by = {name: np.array([x, y]) / r * value for name, value in radial.items()}
        by["p1"] = np.array([r**2 + 2 * x * x, 2 * x * y])
        by["p2"] = np.array([2 * x * y, r**2 + 2 * y * y])
        names = [name for name in by if name in columns]
        at = [columns[name] for name in names]
        design = np.array([by[name] for name in names]).T
        covariance = design @ self.adjustment.cofactor[np.ix_(at, at)] @ design.T
        return math.sqrt(self.variance_factor * float(np.trace(covariance))) / sensor.pitch_mm

    def pointing_sigma_px(self, head: str) -> float:
        """Standard deviation of where a head looks against the reference, in its pixels.

        Rotation and principal points are taken together: what they share moves nothing.

        Args:
            head: its name; not the reference.

        Returns:
            Pixels, the larger of both axes.
        """
        result = self.adjustment
        k = [one.name for one in result.network.heads].index(head)
        turn = result.state.head_rotation[k]
        f_mm = self.rig.cone(head).lens.f_mm
        base_f_mm = self.rig.cone(self.reference).lens.f_mm
        own, base = self._interior_columns(head), self._interior_columns(self.reference)
        columns = [int(c) for c in result.layout.head_rotation[k]]
        columns += [own["dx0"], own["dy0"], base["dx0"], base["dy0"]]
        # Small changes of the ray of the middle, in the axes of the head, at distance f: a
        # rotation (wx, wy) moves (0, 0, -f) by (-f wy, f wx).
        design = np.zeros((2, len(columns)))
        design[0, 1], design[1, 0] = -f_mm, f_mm
        design[:, 3:5] = np.eye(2)
        ratio = f_mm / base_f_mm
        design[:, 5:7] = -ratio * turn.T[:2, :2]
        covariance = design @ result.cofactor[np.ix_(columns, columns)] @ design.T
        spread = math.sqrt(self.variance_factor * float(np.diag(covariance).max()))
        return spread / self.rig.cone(head).sensors[0].pitch_mm

    def _interior_columns(self, head: str) -> dict[str, int]:
        columns = self.adjustment.layout.interior[self.heads.index(head)]
        return {
            name: int(column) for name, column in zip(INTERIOR, columns, strict=True) if column >= 0
        }


def calibrate_flight(
    rig: Rig, images: FlightImages, *, progress: Progress = lambda _what, _done, _total: None
) -> FlightCalibration:
    """Calibrate the heads of a rig from images of a flight and positions of its exposures.

    Args:
        rig: flown with; heads have one sensor each.
        images: of all heads, with tracks and positions.
        progress: called with what is done, and counts.

    Returns:
        The rig with what was found, and the adjustment.

    Raises:
        FlightCalibrationError: what cannot be determined, named.

    Source: docs/explanation/mathematics/lens.md#calibration-from-a-flight.
    """
    cones = [started(cone) for cone in rig.cones]
    names = [cone.name for cone in cones]
    reference = names.index(rig.master_cone) if rig.master_cone in names else 0
    images = spread_images(cones, images)
    start = start_of(cones, images, reference, progress=progress)
    order = [cones[k] for k in start.heads]
    network = flight_network(cones, images, start)
    try:
        result = _converged(network, progress)
    except RankDefectError as error:
        raise FlightCalibrationError("; ".join(d.sentence for d in error.rank_defects)) from error
    except NetworkError as error:
        raise FlightCalibrationError("; ".join(error.problems)) from error
    new = [with_lens(c, i) for c, i in zip(order, result.state.interior, strict=True)]
    made = with_adjusted_heads(
        rig,
        new,
        result,
        [cone.name for cone in order[1:]],
        order[0].name,
        variance_factor=max(1.0, result.sigma0) ** 2,
    )
    return FlightCalibration(
        rig=made,
        before=rig,
        heads=tuple(cone.name for cone in order),
        reference=order[0].name,
        adjustment=result,
        exposures=len(network.stations.names),
        common=_common(result, [cone.name for cone in order]),
        left_out=start.left_out,
    )


def _converged(network: Network, progress: Progress) -> Adjustment:
    """Adjust without blunders until sigmas of image points are those of their residuals.

    Positions are never taken as better than the receiver states.
    """

    def adjusted(given: Network, settings: AdjustmentSettings) -> Adjustment:
        return adjust(
            given,
            settings,
            progress=lambda what, step, _: progress(f"adjusting: {what}", step, 0),
        )

    first = AdjustmentSettings(
        robust=True, reject_beyond=_REJECT_BEYOND, max_rounds=_MAX_ROUNDS, max_iterations=200
    )
    result = adjusted(network, first)
    table = network.image_points
    accepted = ~result.rejected & (result.weight > 0.0) & ~result.left_out[table.point]
    network = replace(
        network,
        image_points=ImagePoints(
            table.image[accepted],
            table.point[accepted],
            table.xy_mm[accepted],
            table.sigma_mm[accepted],
        ),
    )
    for _ in range(_MAX_SCALINGS):
        factor = {group.name: group.factor for group in result.groups if group.redundancy > 1.0}
        image = np.sqrt([factor.get("image x", 1.0), factor.get("image y", 1.0)])
        plan, height = _position_factors(result)
        if max(abs(image - 1.0).max(), plan - 1.0, height - 1.0) < _SCALED_SHARE:
            break
        points, gnss = network.image_points, network.gnss
        network = replace(
            network,
            image_points=replace(points, sigma_mm=points.sigma_mm * image),
            gnss=replace(gnss, sigma_m=gnss.sigma_m * np.array([plan, plan, height])),
        )
        # Robust weights first: with smaller sigmas the starting values are farther off.
        result = adjusted(network, AdjustmentSettings(robust=True, max_iterations=200))
    return result


def flight_network(cones: list[Cone], images: FlightImages, start: FlightStart) -> Network:
    """The network of all oriented exposures.

    Args:
        cones: heads as `processing.calibration.board.network.started` returns them.
        images: of all heads.
        start: starting values.

    Returns:
        Cameras and heads in the order of `start.heads`; object system: that of the positions.
    """
    order = {head: k for k, head in enumerate(start.heads)}
    tracks = images.tracks
    rows = np.flatnonzero(start.used)
    seen, image = np.unique(tracks.image[rows], return_inverse=True)
    points, point = np.unique(tracks.point[rows], return_inverse=True)
    exposures, station = np.unique(images.exposure[seen], return_inverse=True)
    camera = np.array([order[int(k)] for k in images.head[seen]], dtype=np.int64)
    names = tuple(str(k) for k in exposures)
    held = np.zeros(len(names), bool)
    pitch = np.array([cones[k].sensors[0].pitch_mm for k in start.heads])[camera][image]
    base = cones[start.reference]
    placed = np.flatnonzero(np.isfinite(images.position_m[exposures]).all(axis=1))
    lever = _lever_m(base, images.antenna_m)
    return Network(
        cameras=tuple(camera_of(cones[k]) for k in start.heads),
        stations=Stations(names, start.station_m[exposures], held),
        attitudes=Attitudes(names, start.rotation[exposures], held),
        images=Images(
            tuple(
                f"{e}/{cones[h].name}"
                for e, h in zip(images.exposure[seen], images.head[seen], strict=True)
            ),
            station,
            station,
            camera,
            camera,
        ),
        points=Points(
            tuple(f"t{k}" for k in points),
            start.xyz_m[points],
            np.full((len(points), 3), np.nan),
            np.zeros(len(points), bool),
        ),
        image_points=ImagePoints(
            image,
            point,
            image_points_mm(cones, images)[rows],
            np.stack([TIE_SIGMA_PX * pitch] * 2, axis=1),
        ),
        heads=(
            HeadMounting(base.name, np.eye(3), np.zeros(3)),
            *(
                HeadMounting(
                    cones[k].name,
                    *start.mounting[k],
                    rotation_free=True,
                    offset_free=True,
                    offset_sigma_m=OFFSET_SIGMA_M,
                )
                for k in start.heads[1:]
            ),
        ),
        gnss=Gnss(
            station=placed,
            attitude=placed,
            position_m=images.position_m[exposures[placed]],
            sigma_m=images.position_sigma_m[exposures[placed]],
            lever_m=np.tile(lever, (len(placed), 1)),
            line=np.full(len(placed), -1),
            time_s=np.zeros(len(placed)),
        ),
    )


def _position_factors(result: Adjustment) -> tuple[float, float]:
    """By how much positions are worse than stated, in plan and height; one where they are not.

    Single ones that contradict the others are left out; many of them are worse than stated.
    """
    gnss, state = result.network.gnss, result.state
    turned = np.einsum("nij,nj->ni", state.attitude[gnss.attitude], gnss.lever_m)
    squares = ((state.station[gnss.station] + turned - gnss.position_m) / gnss.sigma_m) ** 2
    out = result.excluded.gnss
    redundancy = {group.name: group.redundancy for group in result.groups}
    factors = []
    for name, axes in (("GNSS plan", [0, 1]), ("GNSS height", [2])):
        left_out = out[:, axes]
        free, counted = redundancy.get(name, 0.0), ~left_out
        if left_out.mean() > _LEFT_OUT_SHARE:
            free, counted = free + float(left_out.sum()), np.ones_like(counted)
        total = float(squares[:, axes][counted].sum())
        factors.append(math.sqrt(max(1.0, total / free)) if free > _LEAST_REDUNDANCY else 1.0)
    return factors[0], factors[1]


def spread_images(cones: list[Cone], images: FlightImages) -> FlightImages:
    """Keep the longest tracks in every part of every image.

    Tracks through several lines, and through several heads, are shorter, and join the block; the
    longest of these are kept as well.

    Args:
        cones: heads, one sensor each.
        images: with all tracks.

    Returns:
        The same images with fewer tracks.
    """
    tracks = images.tracks
    size = np.array(
        [(cone.sensors[0].width_px, cone.sensors[0].height_px) for cone in cones], float
    )
    place = tracks.px / size[images.head[tracks.image]] * _UNIT_PX
    kept = np.zeros(len(tracks.image), bool)
    for group in (None, images.line[images.exposure], images.head):
        rows = np.arange(len(tracks.image))
        if group is not None:
            rows = np.flatnonzero(_has_several(tracks, group[tracks.image]))
        kept[rows] |= spread_tracks(
            tracks.image[rows], tracks.point[rows], place[rows], (_UNIT_PX, _UNIT_PX)
        )
    _, point = np.unique(tracks.point[kept], return_inverse=True)
    spread = Tracks(tracks.image[kept], point, tracks.px[kept], int(point.max(initial=-1)) + 1)
    return replace(images, tracks=spread)


def _has_several(tracks: Tracks, group: Indices) -> NDArray[np.bool_]:
    """Image points of tracks through more than one line or head."""
    least = np.full(tracks.points, np.iinfo(np.int64).max)
    most = np.full(tracks.points, -1)
    np.minimum.at(least, tracks.point, group)
    np.maximum.at(most, tracks.point, group)
    return np.asarray((most > least)[tracks.point])


def _lever_m(base: Cone, antenna_m: Array) -> Array:
    """From the projection centre of the reference head to the antenna, in its camera axes."""
    forward, right, down = antenna_m - np.array(base.position_mm) * 1e-3
    return np.asarray(rotation_matrix(*base.rotation_rad).T @ np.array([right, forward, -down]))


def _common(result: Adjustment, heads: list[str]) -> dict[tuple[str, str], int]:
    table = result.network.image_points
    camera = result.network.images.camera[table.image]
    used = result.weight > 0.0
    seen = np.zeros((len(heads), len(result.network.points.names)), bool)
    seen[camera[used], table.point[used]] = True
    return {
        (heads[a], heads[b]): int((seen[a] & seen[b]).sum())
        for a, b in combinations(range(len(heads)), 2)
    }
