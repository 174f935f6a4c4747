"""Compiling beforehand: after it every kernel of the pipeline is ready."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.kernel_variants import as_toml
from processing.pipelines import parallel_compilation
from processing.pipelines.kernel_compilation import compile_for, kernels
from processing.pipelines.parallel_compilation import (
    KernelCompilationError,
    KernelVariants,
    argument_types,
    compile_recorded,
    recorded_variants,
    signature_text,
)
from processing.rig import find_rig

DOT = "processing.matching.least_squares._dot"
ORTHOGONALISE = "processing.matching.least_squares._orthogonalise"
STRIDE = "processing.matching.sampling.window_stride"
CALLED = """
import json
from processing.pipelines.kernel_compilation import compile_for, kernels
from processing.pipelines.parallel_compilation import signature_text
from processing.rig import find_rig
compile_for(find_rig("ultracam-x-mini"))
found = {name: [signature_text(types) for types in kernel.signatures]
         for name, kernel in kernels().items()}
print(json.dumps(found))
"""
"""Prints the variants of every kernel that the pipeline has called in a fresh process."""


def test_installation_leaves_every_kernel_that_is_called_from_python_ready() -> None:
    done = compile_for(find_rig("ultracam-x-mini"))
    assert set(done.variants) == set(kernels())
    called = {
        "radiometry.level1._flat_pass",
        "radiometry.level1._map_pass",
        "radiometry.defects.interpolate_defects",
        "matching.features.select_features",
        "matching.patches.match_patches",
        "image.balance._node_means",
        "image.seams._cheapest_path",
        "image.seams._feather",
        "image.resampling._resample",
        "image.quicklook._block_means",
    }
    ready = {name.removeprefix("processing.") for name, count in done.variants.items() if count}
    assert ready >= called
    assert compile_for(find_rig("ultracam-x-mini")).compiled == 0


def test_every_variant_that_the_pipeline_calls_is_recorded() -> None:
    """Else it is compiled by one process alone: run `python -m benchmarks.kernel_variants`."""
    # In a process of its own: other tests call kernels with other types.
    called = subprocess.run(
        [sys.executable, "-c", CALLED], capture_output=True, text=True, check=True, timeout=100
    )
    table = recorded_variants()
    for name, signatures in json.loads(called.stdout).items():
        for signature in signatures:
            assert signature in table[name].signatures, name


def test_recorded_variants_are_of_kernels_and_read_as_they_are_written(tmp_path: Path) -> None:
    table = recorded_variants()
    assert set(table) <= set(kernels())
    for entry in table.values():
        assert entry.seconds >= 0.0
        assert [signature_text(argument_types(s)) for s in entry.signatures] == list(
            entry.signatures
        )
    (tmp_path / "written.toml").write_text(as_toml(table), "utf-8")
    assert recorded_variants(tmp_path / "written.toml") == table


COMPILE = """
import json, sys
from processing.pipelines.kernel_compilation import kernels
from processing.pipelines.parallel_compilation import compile_recorded, recorded_variants

if __name__ == "__main__":
    table = {name: recorded_variants()[name] for name in sys.argv[1:]}
    calls = []
    count = compile_recorded(kernels(), table=table, processes=2,
                             progress=lambda name, done, total: calls.append((name, done, total)))
    print(json.dumps([count, calls]))
"""


def test_kernels_compile_after_those_they_call_and_only_once(tmp_path: Path) -> None:
    table = recorded_variants()
    names = [ORTHOGONALISE, DOT, STRIDE]
    script = tmp_path / "compile.py"
    script.write_text(COMPILE, "utf-8")

    def run() -> tuple[int, list[tuple[str, float, float]]]:
        done = subprocess.run(
            [sys.executable, str(script), *names],
            env=os.environ
            | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(Path.cwd())},
            capture_output=True,
            text=True,
            timeout=110,
            check=True,
        )
        count, calls = json.loads(done.stdout)
        return count, calls

    count, calls = run()
    assert count == sum(len(table[name].signatures) for name in names)
    order = [name for name, _, _ in calls]
    assert sorted(order) == sorted(names) and order.index(DOT) < order.index(ORTHOGONALISE)
    total_s = sum(table[name].seconds for name in names)
    assert calls[-1][1:] == [pytest.approx(total_s)] * 2
    assert run() == (0, [])


MISSING = """
from processing.pipelines import kernel_compilation
from processing.pipelines.parallel_compilation import argument_types, recorded_variants
all_kernels = kernel_compilation.kernels()
own = {NAMES}
kernel_compilation.kernels = lambda: {name: all_kernels[name] for name in own}
kernel_compilation.compile_missing()
for name in own:
    kernel = all_kernels[name]
    for text in recorded_variants()[name].signatures:
        kernel.compile(argument_types(text))
    assert not kernel.stats.cache_misses, name
    assert kernel.stats.cache_hits, name
"""


def test_a_process_loads_what_another_compiled_for_it(tmp_path: Path) -> None:
    """Also what another process had to compile again because it was damaged."""
    script = MISSING.replace("{NAMES}", str([ORTHOGONALISE, DOT]))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for _ in range(2):
        subprocess.run([sys.executable, "-c", script], env=environment, timeout=110, check=True)
        (dot,) = (tmp_path / "cache").rglob("least_squares._dot*.1.nbc")
        dot.write_bytes(dot.read_bytes()[:-100])


def test_kernels_that_cannot_be_stored_are_reported_with_their_folder(tmp_path: Path) -> None:
    script = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))\n"
    script += MISSING.replace("{NAMES}", str([DOT]))
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        timeout=110,
    )
    expected = f"{DOT} cannot be compiled: {tmp_path / 'cache'}/matching_"
    assert "KernelCompilationError: " in done.stderr and expected in done.stderr
    assert "could not be written; check the free space and its owner" in done.stderr


@pytest.mark.parametrize(
    ("signature", "reason"), [("(unicode_type,)", "TypeError"), ("(int64, int64)", "TypingError")]
)
def test_a_kernel_that_cannot_be_compiled_is_named(signature: str, reason: str) -> None:
    table = {DOT: KernelVariants((signature,), 1.0)}
    with pytest.raises(KernelCompilationError, match=rf"{DOT} cannot be compiled: {reason}"):
        compile_recorded(kernels(), table=table, processes=1)


def test_a_kernel_whose_process_ends_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel_compilation, "_serve", os.abort)
    table = {DOT: KernelVariants(("(int64, int64)",), 1.0)}
    with pytest.raises(
        KernelCompilationError, match=f"compiled {DOT} ended; check the free memory"
    ):
        compile_recorded(kernels(), table=table, processes=1)
