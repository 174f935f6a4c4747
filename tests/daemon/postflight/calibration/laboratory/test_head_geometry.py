"""`calibrate head` before the emulated collimator, held against its truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from typer.testing import CliRunner

from daemon.cli.calibrate import app
from daemon.postflight.calibration.laboratory.head_geometry import (
    FREE,
    CollimatorSeries,
    Target,
    head_network,
)
from daemon.postflight.calibration.laboratory.laboratory_series import SeriesError, read_series
from daemon.postflight.calibration.laboratory.radiometric import RadiometricSeries
from processing.bundle.adjust import adjust
from processing.bundle.network import INTERIOR
from processing.geometry.placement import layer_mm_from_raw
from processing.geometry.residual_grid import grid_from_bytes
from processing.matching.target_matching import TargetImage, first_guess, positions_of
from processing.rig import find_rig, load_rig, shipped_rigs
from sim_hw.laboratory import collimator

RIG = "dmc-mini"
GRID = (7, 5)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    root = tmp_path_factory.mktemp("collimator")
    rig = find_rig(RIG)
    for take in (1, 2):
        collimator.write_series(
            rig, shipped_rigs()[RIG], root / str(take), sensors=["P1"], seed=1, take=take, grid=GRID
        )
    yield root


def _calibrated(*arguments: str) -> dict[str, Any]:
    run = CliRunner().invoke(app, ["head", *arguments, "--json"])
    assert run.exit_code == 0, run.output
    output: dict[str, Any] = json.loads(run.stdout)
    return output


def test_a_head_comes_out_below_a_twentieth_of_a_pixel_and_the_grid_takes_the_rest(
    laboratory: Path,
) -> None:
    output = _calibrated(str(laboratory / "1" / "series"), "--out", str(laboratory / "a"))
    figures = output["figures"]["1"]
    assert figures["targets"] > 90
    assert figures["series"] == 4
    assert figures["residual_px"] < 1.0 / 20.0
    # 0.25 um of what the lens does beyond Heier et al. (2002), eq. 5.1, are in the residuals, and
    # hardly in what is left.
    assert figures["residual_with_grid_px"] < 0.75 * figures["residual_px"]
    assert output["serials"]["collimator"] == "SIM-COLLIMATOR-1"
    assert output["serials"]["sensor P1"] == "DM-P1"
    rig = load_rig(laboratory / "a" / "rig.toml")
    assert rig.calibration_id == output["calibration_id"] and rig.calibration_id.startswith("a-")
    assert rig.cone("1").calibration_c == pytest.approx(21.5, abs=0.1)
    assert rig.cone("2") == find_rig(RIG).cone("2")
    truth = collimator.true_head(find_rig(RIG), "P1", 1, extra_um=0.0)
    head = replace(truth, lens=rig.cone("1").lens)
    grid = grid_from_bytes((laboratory / "a" / "residual-grid" / "P1.npz").read_bytes())
    # The lens as calibrated against the true one, up to the rotation that each series takes.
    column, row = (
        g.ravel() for g in np.meshgrid(np.linspace(40, 1750, 15), np.linspace(40, 980, 9))
    )
    with_extra = collimator.true_head(find_rig(RIG), "P1", 1)
    measured = layer_mm_from_raw(rig.sensor("P1"), np.stack([column, row], axis=1))
    error = head.ideal(column, row) + grid.correction_to_ideal(measured)
    error = error - with_extra.ideal(column, row)
    assert float(np.sqrt(np.mean(_less_rotation(measured, error) ** 2))) < 0.012 / 100


def _less_rotation(xy: Any, error: Any) -> Any:
    """Image errors less what three small rotations of the camera make."""
    f = 120.0
    x, y = xy.T
    design = np.stack(
        [np.stack([x * y / f, -f - x * x / f, y]), np.stack([f + y * y / f, -x * y / f, -x])],
        axis=0,
    ).transpose(2, 0, 1)
    solved, *_ = np.linalg.lstsq(design.reshape(-1, 3), error.reshape(-1), rcond=None)
    return error - (design @ solved).reshape(-1, 2)


def test_matching_among_the_targets_has_no_bias(laboratory: Path) -> None:
    from daemon.mission.store.level0 import read_tiff
    from daemon.postflight.calibration.laboratory.head_geometry import _nominal

    series = read_series(laboratory / "1" / "series", CollimatorSeries)
    targets = series.file.images[::2]
    rig = series.rig
    images = []
    for target in targets:
        pixels = read_tiff(target.path).astype(float)
        by_target, bend = _nominal(rig.cone("1"), rig.sensor("P1"), target)
        images.append(TargetImage(pixels, first_guess(pixels), by_target, bend))
    found = positions_of(images, half_px=25)
    assert found.failed == ()
    truth = np.load(laboratory / "1" / "truth" / "P1.npz")["centre_px"][::2]
    error = found.position_px + np.array([t.origin_px for t in targets]) - truth
    # One common shift on the target is nobody's to know; the series' orientation takes it.
    inverse = np.array([np.linalg.inv(i.pixels_by_target) for i in images])
    common = np.einsum("nij,nj->ni", inverse, error).mean(axis=0)
    error -= np.array([i.pixels_by_target for i in images]) @ common
    assert float(np.sqrt(np.mean(error**2))) < 0.002
    assert float(np.abs(error).max()) < 0.008
    # Turned by a quarter, and in the corners, no shift of its own is left.
    for quarter in (0.0, 90.0, 180.0, 270.0):
        own = np.array([t.rotation_deg == quarter for t in targets])
        assert np.abs(error[own].mean(axis=0)).max() < 0.001


def test_the_uncertainty_of_the_parameters_is_honest_over_fifty_seeds() -> None:
    rig = find_rig("dmc")
    cone, sensor = rig.cone("1"), rig.sensor("P1")
    # What matching and a collimator of 0.3 urad give in a head of 120 mm: see
    # docs/how-to/processing/calibration.md.
    sigma_px = 0.004
    squares, beyond_three, errors = 0.0, 0, 0
    worst = 0.0
    for seed in range(50):
        random = np.random.default_rng(seed)
        truth = collimator.true_head(rig, "P1", seed, extra_um=0.0)
        targets, px = [], []
        for holder, rotation in enumerate(collimator.holder_rotations(seed, "P1", 4)):
            for alpha, beta in collimator.angles_of(truth, *GRID, holder):
                at = collimator.seen_at(truth, rotation, alpha, beta)
                if at is not None:
                    px.append(at + random.normal(0.0, sigma_px, 2))
                    targets.append(
                        Target(Path(), "P1", str(holder), alpha, beta, 20.0, 90.0 * holder)
                    )
        network = head_network(
            cone,
            targets,
            layer_mm_from_raw(sensor, np.array(px)),
            sigma_mm=sigma_px * sensor.pitch_mm,
        )
        result = adjust(network)
        columns = result.layout.interior[0]
        free = np.flatnonzero(columns >= 0)
        own = result.cofactor[np.ix_(columns[free], columns[free])]
        names = [INTERIOR[k] for k in free]
        true = np.array([getattr(truth.lens, n if n[0] != "d" else f"{n}_mm") for n in names])
        error = result.state.interior[0][free] - true
        assert len(names) == len(FREE)
        squares += float(error @ np.linalg.solve(own, error))
        standardised = np.abs(error) / np.sqrt(np.diag(own))
        beyond_three += int((standardised > 3.0).sum())
        worst = max(worst, float(standardised.max()))
        errors += len(names)
        assert result.sigma0 == pytest.approx(1.0, abs=0.25)
    low, high = (float(chi2.ppf(p, errors)) for p in (0.0005, 0.9995))
    assert low < squares < high
    assert beyond_three <= 0.01 * errors
    assert worst < 5.0


def test_the_same_head_again_has_not_changed_and_another_lens_has(
    laboratory: Path, tmp_path: Path
) -> None:
    series = laboratory / "2" / "series"
    if not (laboratory / "a").exists():
        _calibrated(str(laboratory / "1" / "series"), "--out", str(laboratory / "a"))
    again = _calibrated(
        str(series), "--out", str(tmp_path / "b"), "--previous", str(laboratory / "a")
    )
    assert len(again["changes"]) == len(FREE)
    assert not [c["what"] for c in again["changes"] if c["significant"]]
    # A lens screwed out by 0.05 mm: the comparison with the earlier calibration reports it.
    content = json.loads((laboratory / "a" / "calibration.json").read_text())
    for q in content["quantities"]:
        if q["what"] == "df":
            q["value"] += 0.05
    content["serials"]["lens 1"] = "other"
    (tmp_path / "before.json").write_text(json.dumps(content))
    moved = _calibrated(
        str(series), "--out", str(tmp_path / "c"), "--previous", str(tmp_path / "before.json")
    )
    assert [c["what"] for c in moved["changes"] if c["significant"]] == ["df"]
    assert any("lens 1 is now" in w for w in moved["warnings"])


def test_too_few_targets_and_another_kind_of_series_are_refused(
    laboratory: Path, tmp_path: Path
) -> None:
    content = json.loads((laboratory / "1" / "series" / "series.json").read_text())
    content["images"] = content["images"][:5]
    (tmp_path / "series.json").write_text(json.dumps(content))
    (tmp_path / "rig.toml").write_bytes(shipped_rigs()[RIG].read_bytes())
    run = CliRunner().invoke(app, ["head", str(tmp_path), "--out", str(tmp_path / "x")])
    assert "5 targets; 12 or more" in str(run.exception)
    content["images"][0]["turned_deg"] = content["images"][0].pop("rotation_deg")
    (tmp_path / "series.json").write_text(json.dumps(content))
    run = CliRunner().invoke(app, ["head", str(tmp_path), "--out", str(tmp_path / "x")])
    assert "images[0].turned_deg is now named rotation_deg; rename it" in str(run.exception)
    with pytest.raises(SeriesError, match="kind is 'head'"):
        read_series(tmp_path, RadiometricSeries)
