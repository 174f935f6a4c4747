"""Limits next to the values of the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.onboard.monitoring.limits import limits_json
from processing.quality.report import Thresholds


def test_limits_are_those_of_the_configuration_and_of_the_plan(tmp_path: Path) -> None:
    (tmp_path / "service.toml").write_text("[processing.thresholds]\nsigma0_px = 0.4\n")
    plan = {"forward_overlap": 0.6, "overlap_tolerance": 0.1, "sun_deg": 20.0, "gsd_m": None}
    found = limits_json(str(tmp_path), plan | {"tilt_deg": 3.0, "crab_deg": 10.0})
    assert found["sigma0_px"] == {"most": 0.4}
    assert found["forward_overlap"] == {"least": 0.5}
    assert found["sun_deg"] == {"least": 20.0}
    # The stricter one of threshold and plan.
    assert (found["tilt_deg"], found["crab_deg"]) == ({"most": 3.0}, {"most": 5.0})
    assert "gsd_m" not in found


@pytest.mark.parametrize("text", [None, "no toml", "[processing]\nthresholds = 7\n"])
def test_an_unreadable_configuration_gives_the_defaults(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "service.toml").write_text(text)
    found = limits_json(str(tmp_path), {})
    assert found["sigma0_px"] == {"most": Thresholds().sigma0_px}
    assert "forward_overlap" not in found
