"""The judge finds the error that was put in, and no other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_hw.truth_comparison import ComparisonError, compare, compare_mission, main

MARK = 1_400_000_000_123_456_789


def exposure(random: np.random.Generator) -> tuple[dict[str, Any], dict[str, Any]]:
    """A truth of two PAN sensors and a colour one, and a geometry without error."""
    columns, rows = np.append(np.arange(0.0, 200, 16), 207), np.append(np.arange(0.0, 140, 16), 149)
    c, r = np.meshgrid(columns, rows)
    truth: dict[str, Any] = {
        "mark_gps_ns": np.array(MARK),
        "sensors": np.array(["A", "B", "G"]),
        "pan_sensors": np.array(["A", "B"]),
    }
    geometry: dict[str, Any] = {}
    for index, name in enumerate("ABG"):

        def column(c: Any, r: Any, k: int = index) -> Any:
            return 150 * k + 1.001 * c + 0.002 * r + 1e-6 * c * c

        def row(c: Any, r: Any) -> Any:
            return 20 - 0.002 * c + 0.999 * r + 2e-6 * r * r

        truth |= {f"{name}.columns": columns, f"{name}.rows": rows}
        truth |= {f"{name}.vip_column": column(c, r), f"{name}.vip_row": row(c, r)}
        raw = random.uniform([0, 0], [207, 149], (400, 2))
        geometry[f"{name}.raw"] = raw
        geometry[f"{name}.vip"] = np.column_stack([column(*raw.T), row(*raw.T)])
        geometry[f"{name}.weight"] = np.ones(400, dtype=np.float32)
    return truth, geometry


def test_a_perfect_geometry_has_no_error() -> None:
    truth, geometry = exposure(np.random.default_rng(0))
    figures = compare(geometry, truth)["methods"].figures
    assert figures["points"] == 800
    assert figures["absolute_max_px"] < 1e-6
    assert figures["inner_max_px"] < 1e-6


def test_a_similarity_is_an_absolute_error_and_no_inner_one() -> None:
    truth, geometry = exposure(np.random.default_rng(0))
    for name in "AB":
        x, y = geometry[f"{name}.vip"].T
        moved = np.column_stack([0.3 + 1e-4 * x - 2e-4 * y, -0.4 + 2e-4 * x + 1e-4 * y])
        geometry[f"{name}.vip"] = geometry[f"{name}.vip"] + moved
    figures = compare(geometry, truth)["methods"].figures
    assert figures["absolute_rms_px"] == pytest.approx(0.5, abs=0.05)
    assert figures["inner_max_px"] < 1e-6


def test_known_noise_comes_out_as_its_length() -> None:
    random = np.random.default_rng(0)
    truth, geometry = exposure(random)
    for name in "AB":
        geometry[f"{name}.vip"] = geometry[f"{name}.vip"] + random.normal(0, 0.1, (400, 2))
    figures = compare(geometry, truth)["methods"].figures
    assert figures["absolute_rms_px"] == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    assert figures["inner_rms_px"] == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    assert figures["absolute_max_px"] > 0.3


def test_the_sign_is_truth_minus_where_it_was_put() -> None:
    truth, geometry = exposure(np.random.default_rng(0))
    geometry["A.vip"] = geometry["A.vip"] + [0.25, 0.0]
    errors = compare(geometry, truth)["methods"].absolute
    assert errors[:400] == pytest.approx(np.tile([-0.25, 0.0], (400, 1)), abs=1e-6)


def test_unused_pixels_and_colour_do_not_count() -> None:
    truth, geometry = exposure(np.random.default_rng(0))
    geometry["A.vip"][:50] += 100.0
    geometry["A.weight"][:50] = 0.0
    geometry["G.vip"] = geometry["G.vip"] + [0.0, 2.0]
    found = compare(geometry, truth)
    assert found["methods"].figures["absolute_max_px"] < 1e-6
    assert found["methods"].figures["points"] == 750
    assert found["colour"].figures["absolute_rms_px"] == pytest.approx(2.0, abs=1e-6)
    assert found["colour"].figures["inner_rms_px"] < 1e-6


def write(folder: Path, number: int, truth: dict[str, Any]) -> None:
    (folder / "truth").mkdir(exist_ok=True)
    np.savez(folder / "truth" / f"{number:06d}.npz", **truth)


def test_exposures_find_their_truth_by_time_and_not_by_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(0)
    for number in (1, 2, 3):
        truth, geometry = exposure(random)
        truth["mark_gps_ns"] = np.array(MARK + number * 3_500_000_000)
        write(tmp_path, number, truth)
        # The mission counts from 11 and never got the first.
        name = f"{number + 10:06d}"
        if number > 1:
            (tmp_path / "L0" / name).mkdir(parents=True)
            (tmp_path / "L2" / name).mkdir(parents=True)
            stamp = int(truth["mark_gps_ns"]) + (20 if number == 2 else -35)
            record = {"mark_gps_ns": str(stamp)}
            (tmp_path / "L0" / name / "exposure.json").write_text(json.dumps(record))
            for part in "AB":
                geometry[f"{part}.vip"] = geometry[f"{part}.vip"] + [0.1 * number, 0.0]
            np.savez(tmp_path / "L2" / name / "geometry.npz", **geometry)
    (tmp_path / "L0" / "000099").mkdir()
    (tmp_path / "L0" / "000099" / "exposure.json").write_text('{"mark_gps_ns": null}')
    status = main(["--mission", str(tmp_path), "--truth", str(tmp_path / "truth")])
    found = json.loads(capsys.readouterr().out)
    assert status == 0
    assert [e["pulse_count"] for e in found["exposures"]] == [2, 3]
    assert [e["time_error_ns"] for e in found["exposures"]] == [20, -35]
    assert found["time_error_ns"] == -35
    assert found["unmatched"] == ["000099"]
    free = found["methods"]["free"]
    assert free["absolute_rms_px"] == pytest.approx(np.sqrt((0.04 + 0.09) / 2), abs=1e-6)
    assert free["absolute_max_px"] == pytest.approx(0.3, abs=1e-6)
    assert free["inner_rms_px"] < 1e-6
    assert list(found["methods"]) == ["free"]


def test_a_folder_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ComparisonError, match="truth folder"):
        compare_mission(tmp_path, tmp_path)
