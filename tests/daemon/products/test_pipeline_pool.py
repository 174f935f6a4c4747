"""Exposures side by side in a few pipelines: the same pixels as one after the other."""

from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import wait
from types import SimpleNamespace

import numpy as np
import pytest

from daemon.products.pipeline_pool import PipelinePool
from processing.pipelines.stitched import Conditions, Pipeline, PipelineSettings, Product
from processing.pipelines.synthetic_frames import synthetic_frames
from processing.rig import find_rig

RIG = find_rig("ultracam-l-mini")


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    pipeline = Pipeline(RIG, None, PipelineSettings(geometry=False))
    pipeline.process(synthetic_frames(RIG), conditions(0))
    return pipeline


def conditions(number: int) -> Conditions:
    """Each exposure warmer than the one before, so that no two are alike."""
    return Conditions(temperatures_c=dict.fromkeys(RIG.probes, 20.0 + 2 * number))


def pixels(product: Product) -> tuple[bytes, ...]:
    images = (product.pan, product.valid, product.quicklook, *product.colour.values())
    return tuple(np.ascontiguousarray(image).tobytes() for image in images)


def test_exposures_side_by_side_are_bit_for_bit_those_of_one_at_a_time(pipeline: Pipeline) -> None:
    frames = synthetic_frames(RIG)
    alone = [pixels(pipeline.process(frames, conditions(k))) for k in range(4)]
    assert len(set(alone)) == 4
    pool = PipelinePool(pipeline, 2)
    futures = [
        pool.submit(lambda processor, k=k: pixels(processor.process(frames, conditions(k))))
        for k in range(4)
    ]
    wait(futures, timeout=300)
    pool.end()
    assert [future.result(timeout=0) for future in futures] == alone


def test_frames_are_let_go_before_the_image_is_made(pipeline: Pipeline) -> None:
    frames = synthetic_frames(RIG)
    expected = pixels(pipeline.process(frames, conditions(1)))

    def overwrite() -> None:
        for frame in frames.values():
            frame[:] = 0

    assert pixels(pipeline.process(frames, conditions(1), frames_read=overwrite)) == expected


def test_two_tasks_never_share_a_pipeline(pipeline: Pipeline) -> None:
    pool = PipelinePool(pipeline, 2)
    both_are_in = threading.Barrier(2)

    def task(processor: Pipeline) -> int:
        both_are_in.wait(timeout=60)
        return id(processor)

    used = {future.result(timeout=60) for future in [pool.submit(task), pool.submit(task)]}
    pool.end()
    assert len(used) == 2


def test_a_task_that_fails_raises_and_frees_its_pipeline(pipeline: Pipeline) -> None:
    pool = PipelinePool(pipeline, 1)

    def fail(processor: Pipeline) -> None:
        raise ValueError(processor.rig.name)

    with pytest.raises(ValueError, match="ultracam-l-mini"):
        pool.submit(fail).result(timeout=60)
    assert pool.submit(lambda processor: processor.rig.name).result(timeout=60) == "ultracam-l-mini"
    pool.end()


def test_a_threading_layer_for_one_thread_gets_one_pipeline(
    pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_numbas_own = SimpleNamespace(
        get_num_threads=lambda: 2, threading_layer=lambda: "workqueue"
    )
    monkeypatch.setattr("daemon.products.pipeline_pool.numba", only_numbas_own)
    pool = PipelinePool(pipeline, 2)
    assert pool.count == 1
    pool.end()


def test_the_count_is_known_before_a_kernel_ran() -> None:
    code = "from daemon.products.pipeline_pool import usable_count; print(usable_count(2))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stdout.strip() in {"1", "2"}, done.stderr
