"""The benchmark of the accelerator states nothing of a device that is not there."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
import pytest

from benchmarks import accelerator


@pytest.mark.parametrize(("same", "status"), [(True, 0), (False, 1), (None, 0)])
def test_other_bits_of_a_device_fail(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    same: bool | None,
    status: int,
) -> None:
    found: dict[str, Any] = {"cuda_has_the_bits_of_cuda_reference": same}
    monkeypatch.setattr(accelerator, "measure", lambda _rig, _runs: found)
    monkeypatch.setattr(sys, "argv", ["accelerator", "ultracam-x-mini"])
    assert accelerator.main() == status
    assert json.loads(capsys.readouterr().out)["cuda_has_the_bits_of_cuda_reference"] is same


def test_one_word_makes_other_bits_and_is_counted() -> None:
    raster = np.full((10, 10), 100, np.uint16)
    changed = raster.copy()
    changed[3, 4] = 93
    assert accelerator.same_bits({"pan": raster}, {"pan": raster.copy()})
    assert not accelerator.same_bits({"pan": raster}, {"pan": changed})
    assert accelerator.differences({"pan": raster}, {"pan": changed})["pan"] == {
        "differing_fraction": 0.01,
        "standard_deviation": 0.696,
        "largest": 7,
    }


@pytest.mark.timeout(300)
def test_without_a_device_only_the_processor_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accelerator, "why_unusable", lambda _device: "no driver")
    found = accelerator.measure(accelerator.find_rig("ultracam-x-mini"), 1)
    assert found["cuda"] == "not measured: no driver"
    assert found["cuda_has_the_bits_of_cuda_reference"] is None
    assert set(found["median_s"]) == {"cpu", "cuda-reference"}
    for name, off in found["cpu_against_cuda_reference"].items():
        assert off["standard_deviation"] < 6.0, name
