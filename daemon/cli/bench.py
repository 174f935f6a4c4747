"""`syntopic bench`: speed and accuracy of the pipeline on a rig, compared with other software."""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import typer

from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table

HELP = """Time the pipeline on one emulated exposure of a rig and compare it with other software.

The exposure (dC 12 K, one sensor displaced) is rendered once by a separate process and cached.
Timed in turn: the pipeline from Level-0 in memory to Level-2 on the disk, the fixed method, a copy
of the same bytes; then the pace with exposures side by side, as the service works (realtime_factor
is the frame interval over the time per exposure); then a bare cv2.remap, and nona + enblend where
they are installed (Debian packages hugin-tools, enblend). Geometry is compared with the truth.

Examples: `syntopic bench ultracam-x-mini`, `syntopic bench ultracam-x --runs 5 --json`
"""


def bench(
    rig: Annotated[str, typer.Argument(help="Name of a shipped rig, or a rig file.")],
    runs: Annotated[int, typer.Option(min=1, help="Number of runs.")] = 5,
    peers: Annotated[
        bool, typer.Option(help="Comparison with cv2.remap and nona + enblend.")
    ] = True,
    threads: Annotated[int, typer.Option(min=1, help="Number of threads of the pipeline.")] = 2,
    parallel: Annotated[int, typer.Option(min=1, help="Exposures processed in parallel.")] = 2,
    folder: Annotated[
        Path | None, typer.Option(help="Folder of rendered exposures (default: cache).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.cli.benchmark import pipeline as measuring
    from daemon.products.processing_threads import thread_counts
    from processing.rig import find_rig

    found = find_rig(rig)
    console = Console(stderr=True)
    with console.status(f"timing {found.name}"):
        place = measuring.benchmark_exposure(rig, found, folder or _cache_folder(found.name))
        console.print(f"Rendered exposures are cached in {place}", soft_wrap=True)
        # In a process of its own, which begins as the service's worker does.
        for name, count in thread_counts(threads).items():
            os.environ.setdefault(name, count)
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as worker:
            result = worker.submit(
                measuring.measure, place, runs=runs, threads=threads, peers=peers, parallel=parallel
            ).result()
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print(result)


def _cache_folder(rig_name: str) -> Path:
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "syntopic" / "bench" / rig_name


def _print(result: dict[str, Any]) -> None:
    console = Console()
    m = result["machine"]
    console.print(
        f"{m['date']}  {m['processor']}, {m['cores']} cores, {m['memory_gib']} GiB, "
        f"load {m['load']}"
    )
    table = light_table(f"Pipeline, {result['rig']}", ("stage",), ("median ms", "least", "most"))
    rows = {**result["stages"], "all": result["pipeline"], "CPU of all": result["cpu_s"]}
    rows |= {"fixed method": result["fixed_method"], "plain copy": result["copy"]}
    for name, times in rows.items():
        figures = (times["median_s"], times["min_s"], times["max_s"])
        table.add_row(name, *(f"{s * 1e3:.0f}" for s in figures))
    console.print(table)
    console.print(
        f"one at a time: {result['megapixels_per_s']:.0f} Mpx/s, {result['ratio_to_copy']:.1f} "
        f"times a copy, factor {result['realtime_factor_alone']:.2f}, {result['tie_points']} tie "
        f"points, {result['peak_rss_mib']} MiB"
    )
    side = result["side_by_side"]
    console.print(
        f"{side['parallel_exposures']} at a time: realtime_factor {result['realtime_factor']:.2f}, "
        f"{side['seconds_per_exposure']:.2f} s and {side['cpu_s_per_exposure']:.2f} CPU s an "
        f"exposure, {side['latency']['median_s']:.2f} s from frames to files"
    )
    console.print(
        f"inner error {result['rms_px']:.4f} px RMS, {result['max_px']:.4f} px at most; fixed "
        f"{result['rms_px_fixed']:.3f}, without TDM {result['rms_px_no_tdm']:.3f}"
    )
    peers = result.get("peers")
    if peers is None:
        console.print("peers: skipped by --no-peers")
        return
    console.print(
        f"cv2.remap of the PAN frames {peers['remap_s'] * 1e3:.0f} ms; composition takes "
        f"{peers['resampling_ratio']:.2f} times that, an exposure of several in parallel "
        f"{peers['ratio_to_remap']:.2f} times"
    )
    stitched = peers["nona_enblend"]
    if "skipped" in stitched:
        console.print(f"nona + enblend: skipped, {stitched['skipped']}")
    else:
        console.print(
            f"nona + enblend {stitched['seconds']:.1f} s, {stitched['ratio_to_pipeline']:.1f} "
            f"times the pipeline; inner error {stitched['rms_px']:.3f} px RMS, "
            f"{stitched['max_px']:.3f} px at most (as calibrated "
            f"{stitched['rms_px_as_calibrated']:.2f} px RMS)"
        )
