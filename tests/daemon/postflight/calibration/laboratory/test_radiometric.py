"""`calibrate radiometric` before the emulated integrating sphere, held against its truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli.calibrate import app
from processing.radiometry.calibration import RadiometryFolder
from processing.rig import Rig, load_rig
from sim_hw.laboratory import sphere

RIG = """
format = 1
name = "two-heads"
timing = "syntopic"
frame_interval_s = 1.0
master_cone = "0"
reference_cone = "0"
[calibration]
id = "two-heads-1"
date = "2026-11-01"
[defaults.sensor]
width_px = 400
height_px = 352
pitch_um = 20.0
bits = 12
black_dn = 64.0
electrons_per_dn = 20.0
read_noise_e = 30.0
""" + "".join(
    f"""
[[cone]]
name = "{name}"
role = "{role}"
bands = ["{band}"]
position_mm = [0, 0, 0]
rotation_rad = [0, 0, 0]
probe = "{name}"
calibration_c = 20.0
[cone.lens]
f_mm = 12.0
f_number = 4.0
serial = "L-{name}"
[[cone.sensor]]
name = "S{name}"
serial = "C-{name}"
x_mm = 0.1
y_mm = -0.2
tdi_row_sign = {sign}
"""
    for name, role, band, sign in (("0", "pan", "pan", 1), ("G", "colour", "green", -1))
)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Rig]]:
    root = tmp_path_factory.mktemp("sphere")
    file = root / "two.toml"
    file.write_text(RIG)
    rig = load_rig(file)
    sphere.write_series(rig, file, root / "1", seed=1, sensors=["S0", "SG"])
    sphere.write_series(rig, file, root / "2", seed=1, take=2, sensors=["S0"], frames=0.5)
    run = CliRunner().invoke(
        app, ["radiometric", str(root / "1" / "series"), "--out", str(root / "a"), "--json"]
    )
    assert run.exit_code == 0, run.output
    (root / "a.json").write_text(run.stdout)
    yield root, rig


def _figures(root: Path) -> dict[str, dict[str, float]]:
    output = json.loads((root / "a.json").read_text())
    found: dict[str, dict[str, float]] = {}
    for q in output["quantities"]:
        found.setdefault(q["where"], {})[q["what"]] = q["value"]
        if q["sigma"] is not None:
            found[q["where"]][f"sigma {q['what']}"] = q["sigma"]
    return found


def test_planted_pixels_columns_and_clusters_are_found_and_nothing_else(
    laboratory: tuple[Path, Rig],
) -> None:
    root, rig = laboratory
    planted = found = false = 0
    maps = RadiometryFolder(root / "a" / "f4", rig)
    for name in ("S0", "SG"):
        kind = np.load(root / "1" / "truth" / f"{name}.npz")["kind"]
        mask = maps[name].defect != 0
        planted += int((kind > 0).sum())
        found += int((mask & (kind > 0)).sum())
        false += int((mask & (kind == 0)).sum())
    assert planted > 1500
    assert found >= 0.99 * planted
    assert false < 0.01 * planted


def test_what_the_correction_leaves_is_shot_noise_at_every_level_aperture_and_tdi(
    laboratory: tuple[Path, Rig],
) -> None:
    root, _ = laboratory
    output = json.loads((root / "a.json").read_text())
    checks = [c for name in ("S0", "SG") for c in output["figures"][name]["checks"]]
    assert len(checks) == 14
    assert sum("TDI" in c["condition"] for c in checks) == 6
    assert all(0.95 < c["ratio"] < 1.05 for c in checks), checks


def test_the_maps_and_the_model_come_back(laboratory: tuple[Path, Rig]) -> None:
    root, rig = laboratory
    figures = _figures(root)
    for name in ("S0", "SG"):
        truth = np.load(root / "1" / "truth" / f"{name}.npz")
        good = truth["kind"] == 0
        found = RadiometryFolder(root / "a" / "f4", rig)[name]
        output = json.loads((root / "a.json").read_text())["figures"][name]
        bias = (found.bias_dn - truth["bias_dn"])[good]
        dark = (found.dark_dn_per_s - truth["dark_e_per_s"] / 20.0)[good]
        assert float(np.std(bias)) == pytest.approx(output["bias_sigma_dn"], rel=0.05)
        # The dark signal itself makes noise in the warm frames, which the common sigma averages.
        assert float(np.std(dark)) == pytest.approx(output["dark_sigma_dn_per_s"], rel=0.15)
        product = (found.gain * truth["lit"])[good]
        assert float(np.std(np.log(product))) == pytest.approx(output["gain_noise"], rel=0.25)
        own = figures[name]
        assert own["system gain K"] == pytest.approx(0.05, abs=4 * own["sigma system gain K"])
        assert own["dark noise"] == pytest.approx(30.0, abs=4 * own["sigma dark noise"])
        doubling = own["sigma dark signal doubling"]
        assert own["dark signal doubling"] == pytest.approx(7.0, abs=4 * doubling)
        assert own["PRNU"] == pytest.approx(1.0, rel=0.02)
        assert own["DSNU"] == pytest.approx(float(np.std(truth["bias_dn"][good])), rel=0.1)
        assert own["linearity error"] < 0.05
        assert own["response"] == pytest.approx(0.0, abs=4 * own["sigma response"])


def test_calibrated_again_nothing_has_changed_and_other_apertures_follow_from_the_model(
    laboratory: tuple[Path, Rig], tmp_path: Path
) -> None:
    root, rig = laboratory
    out = tmp_path / "b"
    run = CliRunner().invoke(
        app,
        [
            *("radiometric", str(root / "2" / "series"), "--out", str(out), "--json"),
            *("--aperture", "5", "--previous", str(root / "a")),
        ],
    )
    assert run.exit_code == 0, run.output
    output = json.loads(run.stdout)
    assert output["previous"] == json.loads((root / "a.json").read_text())["calibration_id"]
    assert len(output["changes"]) == 11
    significant = [c for c in output["changes"] if c["significant"]]
    assert not significant, significant
    page = (out / "report.html").read_text()
    assert "Maps against the previous calibration" in page
    # f/5 was not measured: between f/4 and f/5.7 it follows from the model.
    truth = sphere.head_truth(rig.cones[0], rig.sensor("S0"), 1)
    good = truth.kind == 0
    light = truth.lit(5.0 / 4.0)
    by_model = np.log((RadiometryFolder(out / "f5", rig)["S0"].gain * light)[good])
    by_neighbour = np.log((RadiometryFolder(out / "f4", rig)["S0"].gain * light)[good])
    noise = output["figures"]["S0"]["gain_noise"]
    assert float(np.std(by_model)) < 1.1 * noise
    assert float(np.std(by_neighbour)) > 5.0 * noise


def test_no_overwriting_and_a_bent_converter_and_a_warming_response_are_seen(
    laboratory: tuple[Path, Rig], tmp_path: Path
) -> None:
    root, rig = laboratory
    again = CliRunner().invoke(
        app, ["radiometric", str(root / "1" / "series"), "--out", str(root / "a")]
    )
    assert again.exit_code != 0
    assert "never overwritten" in str(again.exception)
    sphere.write_series(
        rig,
        root / "two.toml",
        tmp_path,
        seed=3,
        sensors=["S0"],
        nonlinearity=0.03,
        response_per_k=5e-4,
        frames=0.4,
    )
    run = CliRunner().invoke(
        app, ["radiometric", str(tmp_path / "series"), "--out", str(tmp_path / "c"), "--json"]
    )
    assert run.exit_code == 0, run.output
    output = json.loads(run.stdout)
    error = next(q["value"] for q in output["quantities"] if q["what"] == "linearity error")
    assert 0.2 < error < 1.0
    assert any("photon transfer" in w for w in output["warnings"])
    # The pass in flight follows it: the bent converter takes a thirtieth of it.
    found = RadiometryFolder(tmp_path / "c" / "f4", rig)["S0"]
    assert found.response_per_k == pytest.approx(5e-4, rel=0.06)
    assert RadiometryFolder(root / "a" / "f4", rig)["S0"].response_per_k == 0.0


def test_a_list_with_mistakes_is_refused_with_all_of_them(
    laboratory: tuple[Path, Rig], tmp_path: Path
) -> None:
    root, _ = laboratory
    content = json.loads((root / "1" / "series" / "series.json").read_text())
    content["images"][0]["sensor"] = "S9"
    content["images"][1]["file"] = "../out.tif"
    content["images"][2]["f_number"] = 0
    content["images"][3]["mood"] = "good"
    content["images"][4]["temperature_c"] = 90.0
    (tmp_path / "rig.toml").write_text(RIG)

    def refusal() -> str:
        (tmp_path / "series.json").write_text(json.dumps(content))
        command = ["radiometric", str(tmp_path), "--out", str(tmp_path / "x")]
        return str(CliRunner().invoke(app, command).exception)

    output = refusal()
    for expected in ("'S9'", "'../out.tif'", "f_number is 0", "mood"):
        assert expected in output
    del content["images"][:4]
    assert "within 3 K" in refusal()
