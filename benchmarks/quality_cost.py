"""`python -m benchmarks.quality_cost`: CPU seconds of flags, verdicts and sigmas in one exposure.

Processes the exposure of `syntopic bench` and counts the CPU time of the process, all threads, in
each function that serves the quality report: tests of frames, stated accuracy, judgement.
What the radiometric pass takes for them is its time with line sums less that without. The sum is
compared with the CPU time of the pipeline as `syntopic bench` measures it: from Level-0 in memory
to Level-2 in the page cache. The valid area counts as a product.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import statistics
import tempfile
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.cli.benchmark.measurement import machine
from daemon.cli.benchmark.pipeline import benchmark_exposure
from daemon.configuration.model import PlanSection
from daemon.mission.layout import Mission
from daemon.mission.store import direct_io
from daemon.mission.store.store import load_level0
from daemon.orientation.exterior_orientation import mount_of
from daemon.products.exposure_conditions import conditions_of
from daemon.products.exposure_products import FlightGeometry, make_products
from daemon.products.processing_threads import configure_threads, thread_counts
from daemon.products.processor import Processor
from daemon.products.stitched_image import build_stitched
from processing.mosaic import stitching
from processing.pipelines import exposure_pipeline, stitched, stitched_stages
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings
from processing.quality.report import Flag
from processing.radiometry.calibration import RadiometryFolder
from processing.radiometry.corrector import Corrector, corrector_for
from processing.radiometry.level1 import level1_from_level0
from processing.rig import find_rig, load_rig

Array = NDArray[Any]

STEPS: Final = (
    "unread_figures",
    "word_format_figures",
    "repeated_line_figures",
    "line_order_figures",
    "clipping_figures",
    "heads_by_pattern",
    "filled_gaps",
    "find_slips",
    "evaluate_master",
    "check_content",
    "other_ground_regions",
    "check_platform",
    "check_layers",
    "estimate_dc",
    "held_quantities",
    "uncertainty_contribution_of",
    "signal_figures",
    "sharpness_figures",
    "stitching_figures",
    "relative_sharpness_figures",
    "signal_steps",
    "edge_limits",
    "block_edges",
    "block_figures",
    "defect_lines",
    "defect_line_figures",
    "sides_of_blocks",
    "measure_common_windows",
    "local_blur_figures",
    "level_figures",
    "identity_figures",
    "layer_figures",
    "slip_figures",
    "platform_figures",
    "precision_figures",
    "evaluate",
)
"""Functions by their name in `MODULES`."""
MODULES: Final = (stitched, stitched_stages, stitching, exposure_pipeline)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quality_cost")
    add = parser.add_argument
    add("--rig", default="ultracam-x", help="Name of a shipped rig (default: ultracam-x).")
    add("--runs", type=int, default=5, help="Exposures timed (default: 5).")
    add("--threads", type=int, default=2, help="Cores the pipeline may use (default: 2).")
    add("--json", action="store_true", help="Print one JSON object.")
    given = parser.parse_args()
    # As the service's worker begins: no thread spins while it waits, which would count as work.
    os.environ.update(thread_counts(given.threads))
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as worker:
        result = worker.submit(measure, given.rig, given.runs, given.threads).result()
    print(json.dumps(result) if given.json else table(result))


def measure(rig_name: str, runs: int, threads: int) -> dict[str, Any]:
    """Medians of CPU seconds by step, of their sum and of the pipeline, over `runs` exposures."""
    configure_threads()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = benchmark_exposure(
        rig_name, find_rig(rig_name), cache / "syntopic" / "bench" / rig_name
    )
    mission = Mission.open(folder / "mission")
    rig = load_rig(mission.rig_path)
    plan = tomllib.loads(mission.service_path.read_text(encoding="utf-8")).get("plan", {})
    settings = PipelineSettings(geometry=False, threads=threads)
    radiometry = RadiometryFolder(folder / "calibration" / "radiometry", rig)
    pipeline = Pipeline(rig, radiometry, settings)
    pipeline.warm_up()
    stored, exposure = load_level0(mission.level0(1), rig)
    frames = {name: np.array(frame) for name, frame in stored.items()}
    section = PlanSection.model_validate(plan)
    conditions = conditions_of(exposure, rig, section, Flag(0))
    processor = Processor(pipeline, build_stitched)
    flown = FlightGeometry(mount_of(mission)[0], section)
    used: dict[str, float] = defaultdict(float)
    for name in STEPS:
        for module in MODULES:
            if hasattr(module, name):
                setattr(module, name, _counted(getattr(module, name), name, used))
    correctors = {s.name: corrector_for(s, radiometry.get(s.name)) for s in rig.sensors}
    by_run: list[dict[str, float]] = []
    for _ in range(runs + 1):
        used.clear()
        with tempfile.TemporaryDirectory(prefix="syntopic-quality-") as scratch:
            began = time.process_time()
            products = make_products(processor, flown, exposure, frames)
            computed = time.process_time() - began
            for file, parts in products.contents.items():
                direct_io.create_file(Path(scratch) / file, parts)
            whole = time.process_time() - began
        used["line sums in level1_from_level0"] = _line_sums_s(correctors, frames, conditions)
        of_run = {**used, "all steps": sum(used.values())}
        by_run.append({**of_run, "pipeline without writing": computed, "pipeline": whole})
    # The first exposure fills caches.
    of = {key: statistics.median(run[key] for run in by_run[1:]) for key in by_run[0]}
    share = of["all steps"] / of["pipeline"]
    return {"machine": machine(), "rig": rig.name, "runs": runs, "cpu_s": of, "share": share}


def _line_sums_s(
    correctors: Mapping[str, Corrector], frames: Mapping[str, Array], conditions: Conditions
) -> float:
    """CPU seconds that the line sums add to the radiometric pass over all frames."""
    used = {False: 0.0, True: 0.0}
    for name, corrector in correctors.items():
        # Memory that was written before: the first run would pay for its pages.
        out = np.ones_like(frames[name])
        for measure_lines in (True, False, True, False):
            began = time.process_time()
            level1_from_level0(
                corrector,
                frames[name],
                temperature_c=None,
                exposure_time_s=conditions.exposure_time_s.get(name, 0.0),
                tdi_shifts=conditions.tdi_shifts.get(name, 0),
                out=out,
                measure_lines=measure_lines,
            )
            used[measure_lines] += 0.5 * (time.process_time() - began)
    return used[True] - used[False]


def _counted(function: Callable[..., Any], name: str, used: dict[str, float]) -> Callable[..., Any]:
    @functools.wraps(function)
    def timed(*args: Any, **others: Any) -> Any:
        began = time.process_time()
        try:
            found = function(*args, **others)
            return tuple(found) if isinstance(found, Iterator) else found
        finally:
            used[name] += time.process_time() - began

    return timed


def table(result: dict[str, Any]) -> str:
    """Markdown: CPU milliseconds by step, the largest first."""
    lines = ["| step | CPU ms |", "|---|---|"]
    ordered = sorted(result["cpu_s"].items(), key=lambda item: item[1])
    lines += [f"| `{name}` | {seconds * 1e3:.1f} |" for name, seconds in ordered]
    lines.append(f"\nshare of the pipeline: {result['share']:.1%}  {json.dumps(result['machine'])}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
