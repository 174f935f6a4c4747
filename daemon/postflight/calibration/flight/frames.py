"""Frames and positions of missions, as the calibration from a flight takes them.

Which exposures are used, which images are compared, and tracks of features through them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.store.level0 import RasterError, read_tiff
from daemon.orientation.exterior_orientation import mount_of, sealed_exposures
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.rtklib_positions import SUFFIX, read_positions
from daemon.orientation.trajectory import read_trajectory, trajectory_of_samples
from processing.calibration.flight.images import FlightImages
from processing.calibration.flight.plausible_pairs import contradicting_pairs
from processing.matching.board_corners import grey_picture
from processing.matching.photograph_tracks import (
    ImageFeatures,
    features_of,
    join_tracks,
    match_photographs,
)
from processing.rig import Cone, Rig, load_rig

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

IMAGES_MAX: Final = 120
"""Frames that are used unless more are asked for: matching takes minutes."""
EXPOSURES_MIN: Final = 6
FEATURES_MAX: Final = 3000
POSITION_SIGMA_M: Final = (3.0, 5.0)
"""Horizontal and vertical, of a receiver that states none."""
TRAJECTORY_SIGMA_M: Final = (0.05, 0.08)
"""Of a post-processed trajectory that states none."""
_SAME_LINE: Final = 6
_OTHER_LINES: Final = 8
"""Exposures, nearest first, that the images of one are compared with."""


class FlightFramesError(DaemonError, ValueError):
    """Missions that a rig cannot be calibrated from; the message states what is missing."""


@dataclass(frozen=True)
class FlightFrames:
    """Images with tracks and positions, and what they are of.

    `apart_m` is the largest distance flown between frames of one exposure; `temperature_c` the mean
    of each probe; `without_sigma` counts positions without a standard deviation, for which
    `default_sigma_m` is taken, horizontal and vertical. `plausible` are the images without pairs
    that seem to contradict the positions; None where there are none. Of `matched` pairs of images,
    `contradicting` ones were left out.
    """

    rig: Rig
    missions: tuple[str, ...]
    images: FlightImages
    exposures: int
    available: int
    apart_m: float
    temperature_c: dict[str, float]
    without_sigma: int
    default_sigma_m: tuple[float, float]
    unreadable: tuple[str, ...]
    plausible: FlightImages | None = None
    contradicting: int = 0
    matched: int = 0
    plausible_pairs: int = 0

    def without_contradicting(self, plausible: FlightImages) -> FlightFrames:
        """The same flight by `plausible` alone: for ground that repeats itself."""
        wrong = self.matched - self.plausible_pairs
        return replace(self, images=plausible, plausible=None, contradicting=wrong)


@dataclass(frozen=True)
class _Candidate:
    """An exposure with a position and frames."""

    mission: Mission
    exposure: Exposure
    position: tuple[float, float, float]
    line: str


def read_flight(
    missions: Sequence[Path],
    *,
    exposures_max: int | None = None,
    trajectory_file: Path | None = None,
    progress: Progress = lambda _what, _done, _total: None,
) -> FlightFrames:
    """Read frames of the exposures that lie closest together, over all lines and heights.

    Args:
        missions: flown with one rig file.
        exposures_max: number of exposures; None: so that there are 120 frames at most.
        trajectory_file: post-processed positions; None: those of the flight.
        progress: called with what is done, and counts.

    Raises:
        FlightFramesError: another kind of rig, different rigs, or too few frames with a position.
        TrajectoryError: as `daemon.orientation.trajectory`.
    """
    held = [Mission.open(path) for path in missions]
    rig = _common_rig(held)
    candidates = [found for mission in held for found in _candidates(mission, rig, trajectory_file)]
    if len(candidates) < EXPOSURES_MIN:
        raise FlightFramesError(
            f"{', '.join(str(mission.path) for mission in held)}: {len(candidates)} sealed "
            f"exposures with frames and a position with height; {EXPOSURES_MIN} are needed"
        )
    place = np.array([one.position for one in candidates])
    frame = LocalFrame(*(float(v) for v in place[:, :2].mean(axis=0)))
    position = frame.from_geodetic(*place.T)
    limit = exposures_max or max(EXPOSURES_MIN, IMAGES_MAX // len(rig.cones))
    kept = _closest(position, limit)
    chosen = [candidates[k] for k in kept]
    moved, apart_m = _at_exposure(chosen, rig, frame)
    default_m = POSITION_SIGMA_M if trajectory_file is None else TRAJECTORY_SIGMA_M
    sigma, without = _sigmas(chosen, default_m)
    head, exposure, features, unreadable = _features(chosen, rig, progress)
    pairs = _pairs(position[kept], [one.line for one in chosen], head, exposure)
    matches = match_photographs(
        features, pairs, progress=lambda done: progress("matching", done, len(pairs))
    )
    points = [one.px for one in features]
    wrong = contradicting_pairs(rig.cones, head, exposure, position[kept], points, matches)
    images = FlightImages(
        head,
        exposure,
        np.unique([one.line for one in chosen], return_inverse=True)[1].astype(np.int64),
        join_tracks(features, matches),
        position[kept] + moved,
        sigma,
        np.array(mount_of(held[0])[0].antenna_m),
    )
    plausible = {pair: found for pair, found in matches.items() if pair not in wrong}
    return FlightFrames(
        rig,
        tuple(mission.id for mission in held),
        images,
        len(chosen),
        len(candidates),
        apart_m,
        _temperatures(chosen),
        without,
        default_m,
        tuple(unreadable),
        plausible=replace(images, tracks=join_tracks(features, plausible)) if wrong else None,
        matched=len(matches),
        plausible_pairs=len(plausible),
    )


def _common_rig(missions: Sequence[Mission]) -> Rig:
    rigs = [load_rig(mission.rig_path) for mission in missions]
    rig = rigs[0]
    other = next((r for r in rigs if r.cones != rig.cones), None)
    if other is not None:
        raise FlightFramesError(
            f"the missions were flown with {rig.calibration_id} and {other.calibration_id}; give "
            "missions of one rig file"
        )
    many = [cone.name for cone in rig.cones if len(cone.sensors) != 1]
    if many:
        raise FlightFramesError(
            f"cone {', '.join(many)} of {rig.name} has several sensors; calibrate it with "
            "`syntopic calibrate lab` and `syntopic calibrate platform`"
        )
    if rig.timing == "syntopic":
        raise FlightFramesError(
            f"the heads of {rig.name} fire one after the other; a flight calibrates heads that are "
            "triggered at one instant. Use `syntopic calibrate lab`"
        )
    return rig


def _candidates(mission: Mission, rig: Rig, trajectory_file: Path | None) -> list[_Candidate]:
    sensors = {sensor.name for sensor in rig.sensors}
    found = []
    exposures = list(sealed_exposures(mission).results.values())
    if trajectory_file is not None:
        exposures = _along_trajectory(exposures, rig, trajectory_file)
    for exposure in exposures:
        navigation = exposure.navigation
        if navigation is None or navigation.height_m is None:
            continue
        if not any(frame.sensor in sensors for frame in exposure.frames):
            continue
        place = (navigation.latitude_deg, navigation.longitude_deg, navigation.height_m)
        found.append(_Candidate(mission, exposure, place, f"{mission.id} {exposure.line_id}"))
    return found


def _along_trajectory(
    exposures: Sequence[Exposure], rig: Rig, trajectory_file: Path
) -> list[Exposure]:
    """Exposures with the positions of a file, at the exposure of the reference head."""
    times = {one.number: _instant_ns(one, rig) for one in exposures}
    known = [gps_ns for gps_ns in times.values() if gps_ns is not None]
    if not known:
        return []
    if trajectory_file.suffix.lower() == SUFFIX:
        samples = read_positions(trajectory_file)
        trajectory = trajectory_of_samples(trajectory_file.stem, samples)
    else:
        trajectory = read_trajectory(trajectory_file, around_gps_ns=known[0])
    return [
        replace(one, navigation=trajectory.at(gps_ns))
        for one in exposures
        if (gps_ns := times[one.number]) is not None
    ]


def _instant_ns(exposure: Exposure, rig: Rig) -> int | None:
    """Mid-exposure of the reference head, or the mark."""
    reference = rig.cone(rig.master_cone) if rig.master_cone else rig.cones[0]
    frame = exposure.frame(reference.sensors[0].name)
    own = None if frame is None else frame.mid_exposure_gps_ns
    return exposure.mark_gps_ns if own is None else own


def _closest(position: Array, count: int) -> NDArray[np.int64]:
    """Indices of the exposures around the place with the most of them, in their order."""
    if len(position) <= count:
        return np.arange(len(position))
    apart = np.linalg.norm(position[:, None, :2] - position[None, :, :2], axis=2)
    reach = np.sort(apart, axis=1)[:, count - 1]
    return np.sort(np.argsort(apart[int(np.argmin(reach))], kind="stable")[:count])


def _at_exposure(chosen: Sequence[_Candidate], rig: Rig, frame: LocalFrame) -> tuple[Array, float]:
    """What was flown from each position to the exposure of the reference head, (n, 3) m.

    Returns also the largest distance flown between frames of one exposure.
    """
    moved, apart = np.zeros((len(chosen), 3)), 0.0
    for k, one in enumerate(chosen):
        navigation = one.exposure.navigation
        if navigation is None or navigation.velocity_ned_mps is None:
            continue
        north, east, down = (v or 0.0 for v in navigation.velocity_ned_mps)
        times = {
            frame.sensor: frame.mid_exposure_gps_ns
            for frame in one.exposure.frames
            if frame.mid_exposure_gps_ns is not None
        }
        own = _instant_ns(one.exposure, rig)
        if own is None:
            continue
        enu = np.array([east, north, -down]) * ((own - navigation.gps_ns) * 1e-9)
        moved[k] = frame.local_from_enu(*one.position[:2]) @ enu
        if times:
            span_s = (max(times.values()) - min(times.values())) * 1e-9
            apart = max(apart, span_s * float(np.hypot(east, north)))
    return moved, apart


def _sigmas(chosen: Sequence[_Candidate], default_m: tuple[float, float]) -> tuple[Array, int]:
    sigma, without = np.empty((len(chosen), 3)), 0
    for k, one in enumerate(chosen):
        navigation = one.exposure.navigation
        plan = None if navigation is None else navigation.horizontal_sigma_m
        height = None if navigation is None else navigation.vertical_sigma_m
        without += not plan or not height
        sigma[k, :2] = plan or default_m[0]
        sigma[k, 2] = height or default_m[1]
    return sigma, without


def _features(
    chosen: Sequence[_Candidate], rig: Rig, progress: Progress
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[ImageFeatures], list[str]]:
    head, exposure, features, unreadable = [], [], [], []
    for e, one in enumerate(chosen):
        progress("features", e, len(chosen))
        for h, cone in enumerate(rig.cones):
            try:
                picture = _picture(one, cone)
            except (OSError, RasterError) as error:
                unreadable.append(str(error))
                continue
            if picture is None:
                continue
            head.append(h)
            exposure.append(e)
            features.append(features_of(picture, features_max=FEATURES_MAX))
    return np.array(head, np.int64), np.array(exposure, np.int64), features, unreadable


def _picture(one: _Candidate, cone: Cone) -> NDArray[np.uint8] | None:
    sensor = cone.sensors[0]
    frame = one.exposure.frame(sensor.name)
    if frame is None:
        return None
    path = one.mission.level0(one.exposure.number) / (frame.file or f"{sensor.name}.tif")
    pixels = read_tiff(path, width_px=sensor.width_px, height_px=sensor.height_px)
    return grey_picture(pixels, sensor.colour_filter_array)


def _pairs(
    position: Array,
    lines: Sequence[str],
    head: NDArray[np.int64],
    exposure: NDArray[np.int64],
) -> list[tuple[int, int]]:
    """Images (a, b), a < b, of one exposure or of exposures near each other."""
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)
    same = np.array([[a == b for b in lines] for a in lines])
    near = np.eye(len(position), dtype=bool)
    own_line = _SAME_LINE if not same.all() else _SAME_LINE + _OTHER_LINES
    for own, count in ((same, own_line), (~same, _OTHER_LINES)):
        order = np.argsort(np.where(own, apart, np.inf), axis=1)[:, : count + 1]
        for k, others in enumerate(order):
            near[k, others[own[k, others]]] = True
    near |= near.T
    return [
        (a, b)
        for a in range(len(head))
        for b in range(a + 1, len(head))
        if near[exposure[a], exposure[b]]
    ]


def _temperatures(chosen: Sequence[_Candidate]) -> dict[str, float]:
    seen: dict[str, list[float]] = {}
    for one in chosen:
        for reading in one.exposure.temperatures:
            if reading.value_c is not None:
                seen.setdefault(reading.probe, []).append(reading.value_c)
    return {probe: round(float(np.mean(values)), 2) for probe, values in seen.items()}
