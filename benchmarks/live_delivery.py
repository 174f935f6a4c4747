"""`python -m benchmarks.live_delivery`: what landing costs, as a function of the exposures flown.

Blocks of lines flown there and back are made of prepared tie points, without images: observations
of drawn ground points with noise, and measured orientations with errors. Timed is what the process
of the live triangulation does after the last exposure: the last adjustment with drifts and
findings, its files, and, with `--map`, the last levelling and the files of the orthomosaic.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.live_orthomosaic import remember
from daemon.cli.benchmark.measurement import machine
from daemon.mission.layout import Mission
from daemon.onboard.triangulation.live_record import write_live
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.local_frame import LocalFrame
from daemon.orientation.navigation_sigmas import NavigationSigmas
from processing.bundle.frame_patterns import FramePatterns
from processing.bundle.self_calibration import parts_of
from processing.geometry.rotation import rotations_from_vectors
from processing.matching.block_matching import pixels_of
from processing.matching.growing_block import ImageTies
from processing.pipelines.live_triangulation import (
    LiveOrientation,
    LiveSettings,
    LiveTriangulation,
    MeasuredImage,
)
from processing.rig import Rig, shipped_rigs

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ABOVE_M: Final = 1500.0
RELIEF_M: Final = 30.0
ALONG, ACROSS = 0.4, 0.7
"""Distances between images and between lines, in their height and width on the ground."""
POINTS: Final = 96
"""Of an image."""
NOISE_PX: Final = 0.03
INTERVAL_S: Final = 1.35
PATTERN_MM: Final = 1e-4


class PreparedFlight:
    """Images with measured orientations and tie points, to be added to a block one by one."""

    def __init__(
        self, rig: Rig, count: int, each: int, *, patterns: int = 0, seed: int = 1
    ) -> None:
        self.random = random = np.random.default_rng(seed)
        assert rig.virtual_image is not None
        self.image = image = rig.virtual_image
        self.parts, self.patterns = parts_of(rig), patterns
        self.size_m = size_m = (
            np.array([image.width_px, image.height_px]) * image.pitch_mm / image.f_mm * ABOVE_M
        )
        self.line, at = np.divmod(np.arange(count), each)
        forth = self.line % 2 == 0
        place = np.where(forth, at, each - 1 - at)
        self.station = np.column_stack(
            [self.line * ACROSS * size_m[0], place * ALONG * size_m[1], np.full(count, ABOVE_M)]
        )
        turn = np.where(forth[:, None, None], np.eye(3), np.diag([-1.0, -1.0, 1.0]))
        self.rotation = turn @ rotations_from_vectors(random.normal(0.0, 0.005, (count, 3)))
        self.velocity = turn[:, :, 1] * ALONG * size_m[1] / INTERVAL_S
        low = self.station[:, :2].min(axis=0) - size_m / 2
        high = self.station[:, :2].max(axis=0) + size_m / 2
        number = round(POINTS * float(np.prod((high - low) / size_m)))
        ground = np.column_stack(
            [random.uniform(low, high, (number, 2)), random.uniform(0.0, RELIEF_M, number)]
        )
        self.ground = ground[np.argsort(ground[:, 1])]

    def begin(self, live: LiveTriangulation) -> None:
        """Give a block the ground points."""
        live.block._extend(len(self.ground))
        live.block._xyz_m[: len(self.ground)] = self.ground

    def add(self, live: LiveTriangulation, k: int) -> None:
        """Add an image as the window would leave it."""
        sigmas = NavigationSigmas()
        position_m, attitude_rad = np.array(sigmas.position_m), sigmas.about_camera_rad
        own, px = self._seen(k)
        name = f"line {self.line[k] + 1}"
        errors = self.random.normal(0.0, attitude_rad)
        measured = MeasuredImage(
            k + 1, name, k * INTERVAL_S,
            self.station[k] + self.random.normal(0.0, position_m),
            self.rotation[k] @ rotations_from_vectors(errors[None])[0],
            position_m, attitude_rad, self.velocity[k], patterns=self._patterns(),
        )  # fmt: skip
        live.images.append(measured)
        covariance = np.diag(np.concatenate([position_m, attitude_rad]) ** 2)
        live.orientations.append(
            LiveOrientation(
                measured, measured.position_m, measured.rotation, covariance, "window", len(own)
            )
        )
        tried = {name: len(own)}
        if self.line[k]:
            tried[f"line {self.line[k]}"] = len(own)
        live.ties.append(ImageTies(tried, tried, 0, np.zeros(2)))
        block = live.block
        block.station_m.append(measured.position_m)
        block.rotation.append(measured.rotation)
        block.line.append(name)
        block.observed.append((own, px))
        block.rays[own] += 1

    def _patterns(self) -> FramePatterns | None:
        if not self.patterns:
            return None
        size = (self.patterns, len(self.parts), 6, 2)
        half_mm = self.image.height_px * self.image.pitch_mm / 2.0
        shape = self.random.normal(0.0, PATTERN_MM, size)
        return FramePatterns(self.parts, shape, half_mm, 0.99)

    def _seen(self, k: int) -> tuple[Indices, Array]:
        ground, station, size_m = self.ground, self.station[k], self.size_m
        reach = np.array([-0.7, 0.7]) * size_m[1]
        own = np.arange(*np.searchsorted(ground[:, 1], station[1] + reach))
        own = own[np.abs(ground[own, 0] - station[0]) < 0.7 * size_m[0]]
        px = pixels_of(self.image, station, self.rotation[k], ground[own])
        last = np.array([self.image.width_px - 1, self.image.height_px - 1])
        seen = ((px > 0) & (px < last)).all(axis=1)
        return own[seen], px[seen] + self.random.normal(0.0, NOISE_PX, (int(seen.sum()), 2))


def land(
    folder: Path, rig: str, count: int, each: int, *, images_max: int, patterns: int
) -> dict[str, Any]:
    """Time and memory of the last adjustment and of its files."""
    mission = folder / f"mission-{count}"
    (mission / "L0").mkdir(parents=True)
    (mission / "rig.toml").write_text(shipped_rigs()[rig].read_text())
    (mission / "service.toml").write_text("[plan]\nground_height_m = 0.0\n")
    settings = LiveSettings(images_max=images_max)
    done = MissionTriangulation(Mission.open(mission), settings)
    done.frame = LocalFrame(47.0, 15.0)
    flown = PreparedFlight(done.rig, count, each, patterns=patterns)
    done.live = LiveTriangulation(flown.image, 0.0, done.settings)
    flown.begin(done.live)
    for k in range(count - each):
        flown.add(done.live, k)
    done.adjust_block()  # as at the end of the last line but one
    for k in range(count - each, count):
        flown.add(done.live, k)
    before_mb = _peak_mb()
    begun, cpu = time.perf_counter(), time.process_time()
    done.land()
    adjusted, adjusted_cpu = time.perf_counter() - begun, time.process_time() - cpu
    begun = time.perf_counter()
    write_live(done)
    last = done.live.last
    assert last is not None
    return {
        "exposures": count,
        "adjusted": len(done.live.last_images),
        "image_points": len(last.result.network.image_points.image),
        "unknowns": last.result.layout.columns,
        "sigma0": last.sigma0,
        "block_s": adjusted,
        "block_cpu_s": adjusted_cpu,
        "files_s": time.perf_counter() - begun,
        "before_mb": before_mb,
        "peak_mb": _peak_mb(),
    }


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live_delivery", description=__doc__)
    parser.add_argument("--rig", default="ultracam-l-mini")
    parser.add_argument("--exposures", type=int, default=500, help="of the flight")
    parser.add_argument("--each", type=int, default=50, help="of them in a line")
    parser.add_argument("--images-max", type=int, default=LiveSettings().images_max)
    parser.add_argument("--patterns", type=int, default=0, help="of stitching, of each image")
    parser.add_argument("--map", action="store_true", help="the orthomosaic instead")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as temporary:
        folder = Path(temporary)
        if options.map:
            found = remember(folder, options.rig, options.exposures, options.each)
        else:
            found = land(
                folder,
                options.rig,
                options.exposures,
                options.each,
                images_max=options.images_max,
                patterns=options.patterns,
            )
    print(json.dumps({"machine": machine(), "figures": found}))


if __name__ == "__main__":
    main()
