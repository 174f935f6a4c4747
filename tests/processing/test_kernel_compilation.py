"""Compiling beforehand: after it every kernel of the pipeline is ready."""

from __future__ import annotations

from processing.pipelines.kernel_compilation import compile_for, kernels
from processing.rig import find_rig


def test_installation_leaves_every_kernel_that_is_called_from_python_ready() -> None:
    done = compile_for(find_rig("ultracam-x-mini"))
    assert set(done.variants) == set(kernels())
    called = {
        "radiometry.level1.flat_pass",
        "radiometry.level1.map_pass",
        "radiometry.level1.interpolate_defects",
        "matching.features.select_features",
        "matching.patches.match_patches",
        "image.balance.node_means",
        "image.seams.cheapest_path",
        "image.seams.feather",
        "image.resampling.resample",
        "image.quicklook.block_means",
    }
    ready = {name.removeprefix("processing.") for name, count in done.variants.items() if count}
    assert ready >= called
    assert compile_for(find_rig("ultracam-x-mini")).compiled == 0
