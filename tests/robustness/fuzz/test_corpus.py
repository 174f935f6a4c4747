"""Every parser survives what was once found by fuzzing, and some blind mutations, within bounds."""

from __future__ import annotations

import itertools
import os
import random
import subprocess
import sys
import time
import tracemalloc

import pytest

from drivers.base.extras import MissingExtraError, missing_module
from tests.robustness.fuzz import corpus
from tests.robustness.fuzz.__main__ import mutations
from tests.robustness.fuzz.target import INPUT_MAX_NBYTES, INPUT_MAX_S, Target
from tests.robustness.fuzz.targets import TARGETS

MUTATIONS = 100
SOAK_SECONDS = float(os.environ.get("SYNTOPIC_FUZZ_SECONDS", "60"))


def target_of(name: str) -> Target:
    try:
        return TARGETS[name]()
    except (ImportError, MissingExtraError) as error:
        if isinstance(error, ImportError) and missing_module(error) is None:
            raise
        pytest.skip(f"an optional package is missing: {error}")


@pytest.mark.trust
@pytest.mark.parametrize("name", TARGETS)
def test_a_parser_survives_its_corpus_within_time_and_memory(name: str) -> None:
    target = target_of(name)
    for seed in target.seeds:
        target.run(seed)  # what is loaded once is not the input's
    spoilt = mutations(target.seeds, random.Random(1))
    tracemalloc.start()
    try:
        for data in (*corpus.read(name), *itertools.islice(spoilt, MUTATIONS)):
            tracemalloc.reset_peak()
            before, begun_s = tracemalloc.get_traced_memory()[0], time.process_time()
            target.run(data)
            took_s = time.process_time() - begun_s
            nbytes = tracemalloc.get_traced_memory()[1] - before
            assert nbytes < INPUT_MAX_NBYTES, f"{nbytes} bytes for {data.hex()[:400]}"
            assert took_s < INPUT_MAX_S, f"{took_s:.1f} s for {data.hex()[:400]}"
    finally:
        tracemalloc.stop()


@pytest.mark.soak
@pytest.mark.parametrize("name", TARGETS)
def test_a_parser_survives_a_minute_of_fuzzing(name: str) -> None:
    target_of(name)
    command = [sys.executable, "-m", "tests.robustness.fuzz", name, "--seconds", str(SOAK_SECONDS)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=10 * SOAK_SECONDS + 300)
    assert done.returncode == 0, done.stdout + done.stderr
