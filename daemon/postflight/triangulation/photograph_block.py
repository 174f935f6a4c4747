"""The block of a mission of photographs: tie points and orientations without any attitude known.

ImageFeatures, tracks and the incremental orientation give the start (`processing.bundle.
incremental_orientation`), positions of EXIF its place, scale and attitude. What is not oriented is
named with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import ExteriorOrientation, sealed_exposures
from daemon.orientation.geodesy import utm_of
from daemon.orientation.georeference import Georeference
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.batch.batch_run import StepCompute, in_this_process
from daemon.postflight.triangulation.photograph_matching import (
    UnmatchedPhotograph,
    matched_photographs,
)
from daemon.postflight.triangulation.triangulation import ImageBlock, TriangulationError
from processing.bundle.incremental_orientation import (
    OrientedBlock,
    PhotographTracks,
    orient_photographs,
)
from processing.bundle.network import CameraModel
from processing.geometry.orientation import grid_from_enu
from processing.geometry.positions_fit import NotPlacedError, PositionsFit, fit_positions
from processing.matching.block_matching import BlockTiePoints, image_mm
from processing.matching.photograph_tracks import (
    MATCHES_MIN,
    ImageFeatures,
    Tracks,
    join_tracks,
    spread_tracks,
)
from processing.pipelines.perspective import perspective_of
from processing.rig import Cone, Rig, VirtualImage, load_rig

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

FREE: Final = ("df", "k1", "k2", "p1", "p2")
"""Estimated parameters; the principal point is held: tilts and a rolling shutter take its place."""
NEIGHBOURS: Final = 10
"""Images whose positions are nearest are compared; without positions all are."""
_ORIENTED_MIN: Final = 3
_CONTRADICTING_SHARE: Final = 0.5
_UPWARD_MAX: Final = 0.2
"""Sine of the elevation of the axis of most photographs of the ground."""
AREA: Final = 0.2
"""Spread of positions over an area: across their main direction, over that along it."""
_WRONG_POSITION_M: Final = 15.0
_WRONG_POSITION: Final = 6.0
"""Of a position that is not used: distance from the block, over the median of all."""
_MAX_PIXELS: Final = 500_000_000
_FOCAL_SIGMA: Final = 0.02
_CORNER_SIGMA: Final = 0.05
_DECENTRING_SIGMA: Final = 0.005


@dataclass(frozen=True)
class PhotographBlock:
    """Oriented photographs with tie points.

    `block`, `tied`: as of any mission, of the oriented images alone; `block.image` is that of the
    first camera. `files` by image name. `cameras` have oriented images, `sizes` are their pixels,
    `camera_of` (n,) is the camera of each image. `left_out` has a sentence for each photograph
    without orientation, `wrong_positions` one for each position of EXIF that is not used.
    `position_m` (n, 3) is NaN where EXIF has none that is used. `orientation` (n,) is that of
    EXIF, by which viewers turn a photograph; empty where none is known. `height_source` is empty
    where positions have heights, "RelativeAltitude" where these are above the takeoff point, and
    "none" where they are taken as zero.
    """

    block: ImageBlock
    tied: BlockTiePoints
    files: Mapping[str, str]
    cameras: tuple[CameraModel, ...]
    sizes: tuple[VirtualImage, ...]
    camera_of: NDArray[np.int64]
    xyz_m: Array
    position_m: Array
    left_out: tuple[str, ...]
    wrong_positions: tuple[str, ...] = ()
    orientation: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    height_source: str = ""

    def image_mm(self, image: NDArray[np.int64], px: Array) -> Array:
        """Image coordinates (m, 2), mm, of pixels (m, 2) of images (m,)."""
        return _image_mm(self.sizes, self.camera_of[image], px)


def photograph_block_of(
    mission: Mission,
    *,
    crs: str | None = None,
    has_control: bool = False,
    compute: StepCompute = lambda _step: in_this_process,
    progress: Progress = lambda _w, _d, _n: None,
) -> PhotographBlock:
    """Match and orient the photographs of a mission.

    Args:
        mission: of the photographs.
        crs: such as EPSG:25833; None is the UTM zone of their middle.
        has_control: control will determine the roll of a single line of photographs.
        compute: where the steps "features" and "matching" are computed.
        progress: called with what is done, how much of it, and of how many.

    Raises:
        TriangulationError: fewer than three photographs that hang together, or positions that do
            not place them.
    """
    rig = load_rig(mission.rig_path)
    sizes = [perspective_of(cone) for cone in rig.cones]
    read = sealed_exposures(mission)
    exposures = list(read.results.values())
    if len(exposures) < _ORIENTED_MIN:
        raise TriangulationError(
            f"{mission.path}: {len(exposures)} photographs can be read; a block takes three"
        )
    geodetic = np.array([_position(exposure) for exposure in exposures])
    known = np.isfinite(geodetic[:, 0])
    if known.sum() < _ORIENTED_MIN:
        raise TriangulationError(f"{mission.path}: {known.sum()} photographs have a position")
    frame = LocalFrame(*(float(v) for v in geodetic[known, :2].mean(axis=0)))
    position = np.full((len(exposures), 3), np.nan)
    position[known] = frame.from_geodetic(*geodetic[known].T)
    heads = {cone.name: k for k, cone in enumerate(rig.cones)}
    camera_of = np.array([heads[exposure.frames[0].sensor] for exposure in exposures], np.int64)
    features, pairs = matched_photographs(
        mission,
        [UnmatchedPhotograph(one, sizes[k]) for one, k in zip(exposures, camera_of, strict=True)],
        candidate_pairs(position),
        compute,
    )
    tracks = join_tracks(features, pairs)
    cameras = [provisional_camera(cone) for cone in rig.cones]
    measured = PhotographTracks(
        tracks.image,
        tracks.point,
        _image_mm(sizes, camera_of[tracks.image], tracks.px),
        len(exposures),
        tracks.points,
        camera_of,
    )
    found = orient_photographs(
        cameras, measured, progress=lambda done: progress("orienting", done, len(exposures))
    )
    names = [_source(exposure) for exposure in exposures]
    if found is None or found.oriented.sum() < _ORIENTED_MIN:
        raise TriangulationError(_unconnected(mission, names, features, len(pairs)))
    placed, wrong = _placed(found, position, has_control=has_control)
    away = np.linalg.norm(placed.station - position, axis=1)
    wrong_position = tuple(
        f"{names[k]}: its position of EXIF is {away[k]:.0f} m from where the other photographs "
        "place it, and is not used"
        for k in np.flatnonzero(wrong)
    )
    position[wrong] = np.nan
    block = _assembled(
        mission, rig, exposures, frame, position, tracks, features, placed, crs, camera_of
    )
    turned = np.array([_orientation(exposure) for exposure in exposures])
    sources = {str(settings.get("HeightSource", "")) for settings in map(_settings, exposures)}
    return replace(
        block,
        wrong_positions=wrong_position,
        orientation=turned[np.flatnonzero(placed.oriented)],
        height_source=max(sources & {"none", "RelativeAltitude"}, default=""),
    )


def _image_mm(sizes: Sequence[VirtualImage], camera: NDArray[np.int64], px: Array) -> Array:
    """Image coordinates (m, 2), mm, of pixels (m, 2) of cameras (m,)."""
    xy_mm = np.empty((len(px), 2))
    for k, size in enumerate(sizes):
        xy_mm[camera == k] = image_mm(size, px[camera == k])
    return xy_mm


def provisional_camera(cone: Cone) -> CameraModel:
    """The head's camera model with the parameters that are estimated, and how well they are known.

    EXIF gives f to 2 %; distortion is within 5 % at the corner.
    """
    image = perspective_of(cone)
    corner = 0.5 * float(np.hypot(image.width_px, image.height_px)) * image.pitch_mm
    sigma = {
        "df": _FOCAL_SIGMA * image.f_mm,
        **{f"k{n}": _CORNER_SIGMA / corner ** (2 * n) for n in (1, 2)},
        "p1": _DECENTRING_SIGMA / corner,
        "p2": _DECENTRING_SIGMA / corner,
    }
    return CameraModel(
        cone.name, image.f_mm, free=frozenset(FREE), sigma=sigma, pixel_mm=image.pitch_mm
    )


def candidate_pairs(position_m: Array) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of images near each other; one without a position goes with all."""
    n = len(position_m)
    distance = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    near = np.argsort(np.where(np.isfinite(distance), distance, np.inf), axis=1)
    found = set()
    for a in range(n):
        everyone = not np.isfinite(position_m[a, 0]) or n <= NEIGHBOURS + 1
        others = range(n) if everyone else near[a, : NEIGHBOURS + 1].tolist()
        found |= {(min(a, b), max(a, b)) for b in others if b != a}
    return sorted(found)


def _position(exposure: Exposure) -> tuple[float, float, float]:
    settings = _settings(exposure)
    keys = ("GpsLatitudeDeg", "GpsLongitudeDeg", "GpsAltitudeM")
    values = [settings.get(key) for key in keys]
    if not all(isinstance(value, int | float) for value in values):
        return (np.nan, np.nan, np.nan)
    a, b, c = (float(value) for value in values if isinstance(value, int | float))
    return (a, b, c)


def _settings(exposure: Exposure) -> Mapping[str, float | int | str]:
    return exposure.frames[0].settings if exposure.frames else {}


def _orientation(exposure: Exposure) -> int:
    value = _settings(exposure).get("Orientation", 1)
    return int(value) if isinstance(value, int | float) and 1 <= value <= 8 else 1


def _source(exposure: Exposure) -> str:
    return str(exposure.frames[0].settings.get("Source", exposure.frames[0].file))


def _unconnected(
    mission: Mission, names: list[str], features: list[ImageFeatures], pairs: int
) -> str:
    counts = [len(one.px) for one in features]
    weak = [f"{n} {c}" for n, c in zip(names, counts, strict=True) if c < 10 * MATCHES_MIN]
    texture = f"; little texture (features): {', '.join(weak[:5])}" if weak else ""
    return (
        f"{mission.path}: no three photographs hang together. {pairs} pairs of images share "
        f"{MATCHES_MIN} or more consistent features of {int(np.median(counts))} in an image "
        f"(median){texture}. Photographs of a block overlap by 60 % and more, show one place, and "
        "are sharp"
    )


def _placed(
    found: OrientedBlock, position: Array, *, has_control: bool = False
) -> tuple[OrientedBlock, NDArray[np.bool_]]:
    """The block brought to the known positions by a similarity, and the positions (n,) that
    contradict it.

    Raises:
        TriangulationError: positions that do not place it, or contradict it as a whole.
    """
    own = found.oriented & np.isfinite(position[:, 0])
    try:
        fit = fit_positions(found.station[own], position[own])
    except NotPlacedError as error:
        if not has_control or own.sum() < _ORIENTED_MIN:
            raise TriangulationError(
                f"the positions of EXIF do not place the block: {error}, or give control points "
                "on both sides of it (--points)"
            ) from error
        fit = _fit_of_line(found, own, position)
    placed = replace(
        found,
        station=fit.applied(found.station),
        rotation=fit.rotation @ found.rotation,
        xyz=fit.applied(found.xyz),
    )
    away = np.linalg.norm(fit.residual_m, axis=1)
    extent = float(np.linalg.norm(position[own][fit.used].std(axis=0)))
    typical = float(np.median(away))
    if typical > _CONTRADICTING_SHARE * extent:
        raise TriangulationError(
            f"photographs and positions of EXIF contradict each other by {typical:.1f} m (median) "
            f"over {extent:.0f} m (standard deviation of positions): positions are not those of "
            "these photographs, or the ground repeats itself"
        )
    upward = -placed.rotation[placed.oriented][:, 2, 2]
    if np.median(upward) > _UPWARD_MAX:
        raise TriangulationError(
            "most photographs look upward where positions of EXIF place them: "
            + _why_upward(position[own])
        )
    wrong = np.zeros(len(position), bool)
    wrong[np.flatnonzero(own)[away > max(_WRONG_POSITION_M, _WRONG_POSITION * typical)]] = True
    return placed, wrong


def _fit_of_line(found: OrientedBlock, own: NDArray[np.bool_], position: Array) -> PositionsFit:
    """The similarity of positions on one line, with the roll by which photographs look down."""
    model, known = found.station[own], position[own]
    extent = float(np.linalg.norm(known.std(axis=0)))
    view = -found.rotation[own][:, :, 2].mean(axis=0)
    below = view / np.linalg.norm(view) * float(np.linalg.norm(model.std(axis=0)))
    fit = fit_positions(
        np.concatenate([model, model + below]),
        np.concatenate([known, known - np.array([0.0, 0.0, extent])]),
    )
    n = len(model)
    return replace(fit, residual_m=fit.residual_m[:n], used=fit.used[:n])


def _why_upward(position: Array) -> str:
    """Positions over an area that let a block look upward are mirrored; on a line, roll is open."""
    along, across = np.linalg.svd(position[:, :2] - position[:, :2].mean(axis=0))[1]
    if across > AREA * along:
        return (
            "they mirror the ground. Latitude and longitude are exchanged, or one has the wrong "
            "sign (GPSLatitudeRef, GPSLongitudeRef). Correct the tags"
        )
    return (
        "the positions do not determine the attitude of the block. Lines across or control points "
        "do"
    )


def _assembled(
    mission: Mission,
    rig: Rig,
    exposures: list[Exposure],
    frame: LocalFrame,
    position: Array,
    tracks: Tracks,
    features: list[ImageFeatures],
    placed: OrientedBlock,
    crs: str | None,
    camera_of: NDArray[np.int64],
) -> PhotographBlock:
    names = [_source(exposure) for exposure in exposures]
    kept = np.flatnonzero(placed.oriented)
    number = np.full(len(exposures), -1)
    number[kept] = np.arange(len(kept))
    rows = np.flatnonzero(placed.used)
    used, camera = np.unique(camera_of[kept], return_inverse=True)
    cones = [rig.cones[k] for k in used]
    sizes = tuple(perspective_of(cone) for cone in cones)
    size = np.array([(one.width_px, one.height_px) for one in sizes])[camera]
    rows = rows[
        spread_tracks(
            tracks.image[rows],
            tracks.point[rows],
            tracks.px[rows],
            size[number[tracks.image[rows]]],
        )
    ]
    points, point = np.unique(tracks.point[rows], return_inverse=True)
    image = number[tracks.image[rows]]
    crs = crs or utm_of(frame.latitude_deg, frame.longitude_deg) or "EPSG:4978"
    oriented = _exteriors(exposures, [cones[k].name for k in camera], kept, placed, frame, crs)
    ground = float(np.median(placed.xyz[points, 2]))
    block = ImageBlock(
        mission, rig, sizes[0], oriented, crs, frame,
        placed.station[kept], placed.rotation[kept], ground,
    )  # fmt: skip
    matched = _matched(image, point)
    tied = BlockTiePoints(image, point, tracks.px[rows], len(points), matched, matched)
    left_out = [
        f"{names[k]} has no orientation: it shares {placed.seen[k]} object points with the block "
        f"({len(features[k].px)} features)"
        for k in np.flatnonzero(~placed.oriented)
    ]
    cameras = tuple(
        replace(provisional_camera(cone), interior=placed.interior[k])
        for cone, k in zip(cones, used, strict=True)
    )
    files = {eo.name: names[k] for eo, k in zip(oriented, kept, strict=True)}
    return PhotographBlock(
        block, tied, files, cameras, sizes, camera.astype(np.int64), placed.xyz[points],
        position[kept], tuple(left_out),
    )  # fmt: skip


def _exteriors(
    exposures: list[Exposure],
    heads: list[str],
    kept: NDArray[np.int64],
    placed: OrientedBlock,
    frame: LocalFrame,
    crs: str,
) -> tuple[ExteriorOrientation, ...]:
    georeference = Georeference(crs)
    found = []
    places = frame.to_geodetic(placed.station[kept])
    for k, head, place in zip(kept, heads, places, strict=True):
        latitude, longitude, height = (float(v) for v in place)
        at = georeference.place(latitude, longitude, height)
        enu = frame.local_from_enu(latitude, longitude).T @ placed.rotation[k]
        found.append(
            ExteriorOrientation(
                exposure=exposures[k].number,
                cone=head,
                is_virtual=False,
                gps_ns=0,
                line_id=exposures[k].line_id,
                strip_id=exposures[k].strip_id,
                latitude_deg=latitude,
                longitude_deg=longitude,
                height_m=height,
                centre_m=np.array([at.east_m, at.north_m, at.height_m]),
                rotation=grid_from_enu(at.azimuth_of_north_rad) @ enu,
                azimuth_of_north_rad=at.azimuth_of_north_rad,
                scale=at.scale,
                method="photographs",
                horizontal_sigma_m=None,
                vertical_sigma_m=None,
            )
        )
    return tuple(found)


def _matched(image: NDArray[np.int64], point: NDArray[np.int64]) -> dict[tuple[int, int], int]:
    """Common object points by pair of images."""
    found: dict[tuple[int, int], int] = {}
    order = np.lexsort((image, point))
    bounds = np.flatnonzero(np.diff(point[order], prepend=-1, append=-2))
    for start, end in pairwise(bounds):
        own = image[order[start:end]].tolist()
        for i, a in enumerate(own):
            for b in own[i + 1 :]:
                found[a, b] = found.get((a, b), 0) + 1
    return found
