"""Timing of the pipeline on one stored exposure, compared with a copy and other methods.

All methods are timed in turn in one run, so that drift of the machine affects all equally. The
peers themselves are in `daemon.cli.benchmark.peers`; the exposure is rendered by a separate
process.
"""

from __future__ import annotations

import json
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.cli.benchmark import peers
from daemon.cli.benchmark.measurement import interleaved, machine, spread
from daemon.configuration.model import PlanSection
from daemon.mission.layout import Mission
from daemon.mission.store import direct_io, store
from daemon.mission.store.output_places import refuse_occupied
from daemon.orientation.exterior_orientation import mount_of
from daemon.products.exposure_conditions import conditions_of
from daemon.products.exposure_products import (
    ExposureProducts,
    FlightGeometry,
    make_products,
    process_exposure,
)
from daemon.products.pipeline_pool import PipelinePool
from daemon.products.processing_threads import configure_threads
from daemon.products.processor import Processor
from daemon.products.stitched_image import build_stitched
from processing.matching.tie_points import TiePoints
from processing.pipelines.stitched import Pipeline, PipelineSettings, Product
from processing.quality.report import Flag
from processing.radiometry.calibration import RadiometryFolder
from processing.rig import Rig, load_rig

DC_K = 12.0
DISPLACED_PX = (1.0, -0.6)
RENDER_TIMEOUT_S = 1800.0
EVALUATION_TIMEOUT_S = 600.0


class BenchError(DaemonError):
    """The exposure to time is not available; the message contains the reason."""


def benchmark_exposure(rig_name: str, rig: Rig, folder: Path) -> Path:
    """The folder with one exposure of a rig, rendered first where it is not there.

    dC is 12 K, one sensor of the master cone is displaced, radiometry is as a laboratory measures.
    """
    if (folder / "ready.json").exists():
        return folder
    if not (folder / "scenes").is_dir():
        refuse_occupied(folder, cure="give another folder with --folder")
    command = [sys.executable, "-m", "sim_hw.processes.exposures", rig_name, "--out", str(folder)]
    command += ["--exposures", "1", "--dc", str(DC_K)]
    master = rig.master_sensors
    if len(master) > 2:
        command += ["--displace", f"{master[2].name}={DISPLACED_PX[0]},{DISPLACED_PX[1]}"]
    _json_of(command, RENDER_TIMEOUT_S, "rendering the exposure", needs_json=False)
    return folder


def measure(
    folder: Path, *, runs: int, threads: int, peers: bool, parallel: int = 2
) -> dict[str, Any]:
    """All figures of one rig as one JSON object; see docs of the command.

    Args:
        folder: from `benchmark_exposure`.
        runs: number of repetitions.
        threads: number of threads of the pipeline.
        peers: also cv2.remap and, where installed, nona + enblend.
        parallel: exposures processed at a time, as the service's `parallel_exposures`.
    """
    configure_threads()
    mission = Mission.open(folder / "mission")
    rig = load_rig(mission.rig_path)
    radiometry = folder / "calibration" / "radiometry"
    plan = _plan_of(mission)
    pipeline = Pipeline(
        rig,
        RadiometryFolder(radiometry, rig),
        PipelineSettings(geometry=False, threads=threads),
    )
    pipeline.warm_up()
    stored, exposure = store.load_level0(mission.level0(1), rig)
    frames = {name: np.array(frame) for name, frame in stored.items()}
    conditions = conditions_of(exposure, rig, plan, Flag(0))
    product = pipeline.process(frames, conditions)
    processor = Processor(pipeline, build_stitched)
    flown = FlightGeometry(mount_of(mission)[0], plan)

    def make(worker: Processor) -> ExposureProducts:
        return make_products(worker, flown, exposure, frames)

    result = {
        "rig": rig.name,
        "machine": machine(),
        "runs": runs,
        "threads": threads,
        **_timed(pipeline, lambda: make(processor), frames, product, runs),
    }
    result |= _side_by_side(processor, make, parallel=parallel, count=3 * runs)
    if peers:
        product = pipeline.process(frames, conditions)
        tie_points = product.tie_points
        result["peers"] = _peers(rig, product, frames, mission, result)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result["peak_rss_mib"] = round(peak / 1024)
    pipeline.settings = replace(pipeline.settings, geometry=True, baselines=True)
    process_exposure(processor, mission, flown, exposure, frames)
    result |= _geometry(mission, folder / "truth")
    if peers and "skipped" not in result["peers"]["nona_enblend"]:
        geometry = _peer_geometry(rig, mission, folder / "truth", tie_points)
        result["peers"]["nona_enblend"] |= geometry
    return result


def _timed(
    pipeline: Pipeline,
    make: Callable[[], ExposureProducts],
    frames: Mapping[str, NDArray[np.uint16]],
    product: Product,
    runs: int,
) -> dict[str, Any]:
    outputs = [product.pan, *product.colour.values()]
    sources = [*frames.values(), *outputs]
    copies = [np.zeros_like(array) for array in sources]
    stages: dict[str, list[float]] = {}
    cpu_s: list[float] = []
    settings = pipeline.settings

    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as scratch:

        def free() -> None:
            began = time.process_time()
            products = make()
            started = time.perf_counter()
            _to_disk(products.contents, Path(scratch))
            stages.setdefault("writing", []).append(time.perf_counter() - started)
            for stage, seconds in products.report["timings_s"].items():
                stages.setdefault(stage, []).append(seconds)
            cpu_s.append(time.process_time() - began)

        def fixed() -> None:
            pipeline.settings = replace(settings, method="fixed")
            _to_disk(make().contents, Path(scratch))
            pipeline.settings = settings

        def copy() -> None:
            for target, source in zip(copies, sources, strict=True):
                np.copyto(target, source)

        free()
        stages.clear()
        cpu_s.clear()
        timed = interleaved(runs, pipeline=free, fixed_method=fixed, copy=copy)
    pixels = sum(frame.size for frame in frames.values())
    seconds = timed["pipeline"]["median_s"]
    return {
        **timed,
        "cpu_s": {"median_s": statistics.median(cpu_s), "min_s": min(cpu_s), "max_s": max(cpu_s)},
        "stages": {stage: spread(values) for stage, values in stages.items() if max(values) > 1e-5},
        "megapixels_in": round(pixels / 1e6, 1),
        "megapixels_per_s": pixels / 1e6 / seconds,
        "ratio_to_copy": seconds / timed["copy"]["median_s"],
        "frame_interval_s": pipeline.rig.frame_interval_s,
        "realtime_factor_alone": pipeline.rig.frame_interval_s / seconds,
        "tie_points": len(product.tie_points),
    }


def _side_by_side(
    processor: Processor,
    make: Callable[[Processor], ExposureProducts],
    *,
    parallel: int,
    count: int,
) -> dict[str, Any]:
    """Throughput and latency of exposures processed in parallel, as in the service.

    Timed from the end of the first exposures to the end of the last, with all pipelines busy.
    Each file is written again, and removed after one further exposure per pipeline.
    """
    work = PipelinePool[Processor](processor, parallel)
    ends: list[float] = []
    latencies: list[float] = []
    used: list[float] = []

    with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as scratch:

        def one(number: int, worker: Processor) -> None:
            started = time.perf_counter()
            folder = Path(scratch) / str(number)
            folder.mkdir()
            _to_disk(make(worker).contents, folder)
            ended = time.perf_counter()
            ends.append(ended)
            used.append(time.process_time())
            latencies.append(ended - started)
            shutil.rmtree(Path(scratch) / str(number - parallel), ignore_errors=True)

        # One exposure per pipeline before, to fill the buffers, and one after, to keep all busy.
        tasks = [work.submit(partial(one, k)) for k in range(count + 2 * work.count)]
        for task in tasks:
            task.result()
        work.end()
    first, last = work.count - 1, work.count - 1 + count
    seconds = (ends[last] - ends[first]) / count
    return {
        "realtime_factor": processor.rig.frame_interval_s / seconds,
        "side_by_side": {
            "parallel_exposures": work.count,
            "exposures": count,
            "seconds_per_exposure": seconds,
            "cpu_s_per_exposure": (used[last] - used[first]) / count,
            "latency": spread(latencies[work.count : last + 1]),
        },
    }


def _peers(
    rig: Rig,
    product: Product,
    frames: Mapping[str, NDArray[np.uint16]],
    mission: Mission,
    result: Mapping[str, Any],
) -> dict[str, Any]:
    pan = {name: frames[name] for name in product.sensors}
    remap_s = peers.remap_seconds(rig, product.mosaic.placements, pan)
    found: dict[str, Any] = {
        "remap_s": remap_s,
        "resampling_ratio": result["stages"]["composition"]["median_s"] / remap_s,
        "ratio_to_remap": result["side_by_side"]["seconds_per_exposure"] / remap_s,
    }
    missing = peers.missing_programs()
    if missing:
        found["nona_enblend"] = {"skipped": missing}
    else:
        seconds = peers.nona_enblend_seconds(rig, mission.level0(1))
        ours = result["pipeline"]["median_s"]
        found["nona_enblend"] = {**seconds, "ratio_to_pipeline": seconds["seconds"] / ours}
    return found


def _peer_geometry(
    rig: Rig, mission: Mission, truth: Path, tie_points: TiePoints
) -> dict[str, float]:
    """Errors of nona against the same truth, at pixels our own table has.

    With frames placed as calibrated, and placed by its own optimiser from our tie points.
    """
    result: dict[str, float] = {}
    with np.load(mission.level2(1) / "geometry.npz") as content:
        ours = {key: content[key] for key in content.files}
    for suffix, given in (("", tie_points), ("_as_calibrated", None)):
        with tempfile.TemporaryDirectory(prefix="syntopic-bench-") as scratch:
            stitched = Path(scratch) / "L2" / "000001"
            stitched.mkdir(parents=True)
            (Path(scratch) / "L0").symlink_to(mission.level0(1).parent.resolve())
            table: Mapping[str, Any] = peers.nona_geometry(rig, mission.level0(1), ours, given)
            np.savez(stitched / "geometry.npz", **table)
            figures = _evaluate_geometry(Path(scratch), truth)["free"]
        result |= {
            f"rms_px{suffix}": figures["inner_rms_px"],
            f"max_px{suffix}": figures["inner_max_px"],
        }
    return result


def _evaluate_geometry(mission: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Figures by method against the truth, which only the judge's own process reads."""
    command = [sys.executable, "-m", "sim_hw.truth_comparison", "--mission", str(mission)]
    evaluated = _json_of(
        [*command, "--truth", str(truth)], EVALUATION_TIMEOUT_S, "judging the geometry"
    )
    return dict(evaluated["methods"])


def _geometry(mission: Mission, truth: Path) -> dict[str, Any]:
    methods = _evaluate_geometry(mission.path, truth)
    return {
        "rms_px": methods["free"]["inner_rms_px"],
        "max_px": methods["free"]["inner_max_px"],
        "rms_px_absolute": methods["free"]["absolute_rms_px"],
        "rms_px_fixed": methods["fixed"]["inner_rms_px"],
        "max_px_fixed": methods["fixed"]["inner_max_px"],
        "rms_px_no_tdm": methods["fixed-no-tdm"]["inner_rms_px"],
    }


def _to_disk(contents: Mapping[str, Sequence[bytes | memoryview]], folder: Path) -> None:
    """Write all files of an exposure as the service does, synced; earlier ones make way."""
    for name, parts in contents.items():
        (folder / name).unlink(missing_ok=True)
        direct_io.create_file(folder / name, parts)


def _plan_of(mission: Mission) -> PlanSection:
    import tomllib

    flown = tomllib.loads(mission.service_path.read_text(encoding="utf-8"))
    return PlanSection.model_validate(flown.get("plan", {}))


def _json_of(
    command: list[str], within_s: float, what: str, *, needs_json: bool = True
) -> dict[str, Any]:
    try:
        completed = subprocess.run(command, capture_output=True, check=True, timeout=within_s)
    except subprocess.TimeoutExpired as error:
        raise BenchError(f"{what} took longer than {within_s:.0f} s") from error
    except subprocess.CalledProcessError as error:
        last = error.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise BenchError(f"{what} failed: {last[0] if last else error.returncode}") from error
    return dict(json.loads(completed.stdout)) if needs_json else {}
