"""Frames without light against those of other heads, in words of noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.quality.dark_frames import dark_frame_figures, dark_frames
from processing.quality.evaluation import evaluate
from processing.quality.figures import QualityFigures
from processing.quality.figures.image import DarkFrameFigures
from processing.quality.report import Flag, Verdict
from processing.radiometry.level1 import LEVEL1_FLOOR, level1_counts_per_dn
from processing.rig import Rig, find_rig

pytestmark = pytest.mark.trust

RIG = find_rig("ultracam-l-mini")
NOISE_DN = 1.5


def words(signal_dn: float, *, noise_dn: float = NOISE_DN, seed: int = 1) -> NDArray[np.uint16]:
    random = np.random.default_rng(seed)
    counts = random.normal(signal_dn, noise_dn, (416, 624)) * level1_counts_per_dn(12)
    return np.clip(np.rint(counts), LEVEL1_FLOOR, 65534).astype(np.uint16)


def exposure(**signal_dn: float) -> dict[str, NDArray[np.uint16]]:
    lit = {sensor.name: 800.0 for sensor in RIG.sensors} | signal_dn
    return {name: words(dn, seed=k) for k, (name, dn) in enumerate(lit.items())}


def found(frames: dict[str, Any], *, rig: Rig = RIG, **scales: float) -> set[str]:
    return set(dark_frames(rig, frames, scales))


@pytest.mark.parametrize("noise_dn", [NOISE_DN, 2.0 * NOISE_DN])
@pytest.mark.parametrize("name", ["SU10", "N"])
def test_noise_about_black_is_no_light(name: str, noise_dn: float) -> None:
    frames = exposure() | {name: words(0.0, noise_dn=noise_dn)}
    (noises,) = dark_frames(RIG, frames, {}).values()
    assert noises == pytest.approx(1.645 * noise_dn / NOISE_DN, rel=0.1)
    assert found(frames) == {name}


@pytest.mark.parametrize(
    ("signals_dn", "dark"),
    [
        ({"N": 9.0}, {"N"}),
        ({"N": 11.0}, set()),
        ({"SU00": 300.0, "SU10": 300.0, "RGB": 250.0, "N": 11.0}, set()),
        ({"SU00": 100.0, "SU10": 100.0, "RGB": 60.0, "N": 6.0}, set()),
        ({"SU00": 0.0, "SU10": 0.0}, {"SU00", "SU10"}),
        ({"SU00": 0.0, "SU10": 0.0, "RGB": 0.0}, set()),
        ({"SU00": 20.0, "SU10": 20.0, "RGB": 20.0, "N": 20.0}, set()),
    ],
    ids=["shut", "a little light", "water", "dusk", "half of the heads", "most heads", "night"],
)
def test_dark_ground_is_lit(signals_dn: dict[str, float], dark: set[str]) -> None:
    assert found(exposure(**signals_dn)) == dark


def test_no_data_is_no_darkness_and_does_not_hide_it() -> None:
    frames = exposure()
    frames["N"][:] = 0
    assert found(frames) == set()
    frames["N"][:200] = words(0.0)[:200]
    assert found(frames) == {"N"}
    assert found({}) == set()


def test_noise_counts_as_the_exposure_time_has_scaled_it() -> None:
    frames = exposure(N=20.0)
    assert found(frames) == set()
    assert found(frames, N=4.0) == {"N"}


def test_a_rig_file_without_read_noise_leaves_one_in_4096_parts() -> None:
    silent = replace(
        RIG,
        cones=tuple(
            replace(c, sensors=tuple(replace(s, read_noise_e=0.0) for s in c.sensors))
            for c in RIG.cones
        ),
    )
    assert found(exposure(N=0.0), rig=silent) == {"N"}


def test_a_frame_without_light_is_flown_again() -> None:
    assert dark_frame_figures({}) is None
    figures = dark_frame_figures({"SU00": 1.6, "N": 3.0})
    assert figures == DarkFrameFigures(("SU00", "N"), 3.0)
    report = evaluate(QualityFigures(figures))
    assert (report.verdict, report.flags) == (Verdict.REFLY, Flag.FRAME_CORRUPT)
    assert "No light in the frame of SU00, N" in report.findings[0].sentence
