"""Level-3 of a mission laid out by hand: files others read, one tone, whole folders only."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import ConfigurationError
from daemon.mission.layout import Mission, MissionError
from daemon.mission.store.level0 import read_description, tiff_parts
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.products import level3
from processing.rig import find_rig, load_rig, rig_from_mapping
from tests.processing.image.test_pansharpening import box_means, scene

BANDS = ("red", "green", "blue", "nir")
RATIO = 3


def write_level2(mission, number, pan, colour, *, exposure_us=None):
    """Level-2 of one exposure, and a record that knows the exposure time."""
    for folder in (mission.level2(number), mission.level0(number)):
        folder.mkdir(parents=True, exist_ok=True)
    bands = [band for band in BANDS if band in colour]
    planes = [np.ascontiguousarray(colour[band]) for band in bands]
    parts = tiff_parts(planes, {"bands": bands, "exposure": number})
    (mission.level2(number) / "rgbn.tif").write_bytes(b"".join(parts))
    parts = tiff_parts([np.ascontiguousarray(pan)], {"bands": ["pan"], "exposure": number})
    (mission.level2(number) / "pan.tif").write_bytes(b"".join(parts))
    frames = [{"sensor": s, "exposure_time_us": exposure_us, "width_px": 1, "height_px": 1}
              for s in "RGBN"]  # fmt: skip
    record = {"number": number, "frames": frames if exposure_us else []}
    (mission.level0(number) / "exposure.json").write_text(json.dumps(record))


@pytest.fixture
def mission(tmp_path):
    """Three exposures over the same ground, the second exposed for half as long."""
    path = tmp_path / "by-hand"
    (path / "L0").mkdir(parents=True)
    content = tomllib.loads(rig_toml(find_rig("ultracam-x-mini")).decode())
    content["virtual_image"] |= {"width_px": 360, "height_px": 300}
    (path / "rig.toml").write_bytes(rig_toml(rig_from_mapping(content, "rig.toml")))
    created = Mission.open(path)
    _, pan, colour = scene(RATIO)
    pan, colour = pan[:300], {name: band[:100] for name, band in colour.items()}
    halved = {name: (band // 2).astype(np.uint16) for name, band in colour.items()}
    write_level2(created, 1, pan, colour, exposure_us=4000.0)
    write_level2(created, 2, (pan // 2).astype(np.uint16), halved, exposure_us=2000.0)
    write_level2(created, 3, pan, colour, exposure_us=4000.0)
    return created


def developed(mission, numbers=(1, 2, 3), **options):
    rig = load_rig(mission.rig_path)
    tones, unreadable = level3.mission_tones(mission, rig)
    assert unreadable == ()
    return tones, [level3.pansharpen(mission, rig, n, tones, **options) for n in numbers]


def test_the_images_are_tiled_and_read_by_others(mission):
    _, done = developed(mission)
    folder = mission.path / "L3" / "000001"
    names = {"rgb-16.tif", "rgb-8.tif", "cir-16.tif", "cir-8.tif"}
    assert set(done[0].files) == {p.name for p in folder.iterdir()} == names
    assert all((folder / name).stat().st_size == size for name, size in done[0].files.items())
    for name in names:
        with tifffile.TiffFile(folder / name) as tiff:
            page = tiff.pages[0]
            assert page.is_tiled and page.tilewidth == page.tilelength == 256
            assert page.compression == tifffile.COMPRESSION.ADOBE_DEFLATE
            assert page.shape == (300, 360, 3) and page.photometric.name == "RGB"
            assert page.dtype == (np.uint16 if "16" in name else np.uint8)
    about = read_description(folder / "cir-8.tif")
    assert about["bands"] == ["nir", "red", "green"] and about["exposure"] == 1
    assert about["level"] == 3


def test_16_bits_keep_the_radiometry_of_level_2(mission):
    developed(mission, numbers=(2,))
    rgb = tifffile.imread(mission.path / "L3" / "000002" / "rgb-16.tif")
    colour = tifffile.imread(mission.level2(2) / "rgbn.tif")
    for k in range(3):
        error = box_means(rgb[:, :, k].astype(np.float64), RATIO) / colour[k] - 1.0
        assert np.abs(error).max() < 0.005


def test_one_curve_serves_all_exposures_and_neighbours_match(mission):
    tones, _ = developed(mission)
    root = mission.path / "L3"
    hashes = {
        read_description(root / f"00000{n}" / "rgb-8.tif")["tone_curve_sha256"] for n in (1, 2, 3)
    }
    assert hashes == {tones.sha256}
    pictures = [tifffile.imread(root / f"00000{n}" / "rgb-8.tif").astype(int) for n in (1, 2, 3)]
    assert np.array_equal(pictures[0], pictures[2])
    assert tones.scales[2]["red"] == 2.0 and tones.scales[1]["red"] == 1.0
    difference = np.abs(pictures[1] - pictures[0])
    assert difference.mean() < 0.5 and np.percentile(difference, 99.9) <= 3
    assert 80 < pictures[0].mean() < 140
    again, _ = developed(mission, numbers=(2,), depths=(8,))
    assert again.sha256 == tones.sha256


def test_options_are_applied_and_an_earlier_result_is_replaced(mission):
    developed(mission, numbers=(1,))
    stale = mission.path / "L3" / "000001.0123abcd.part"
    stale.mkdir()
    (stale / "rgb-8.tif").write_bytes(b"half")
    developed(mission, numbers=(1,), images=("cir",), depths=(8,))
    assert [p.name for p in (mission.path / "L3" / "000001").iterdir()] == ["cir-8.tif"]
    assert sorted(p.name for p in (mission.path / "L3").iterdir()) == ["000001", "tone-curve.json"]


def test_the_command_pansharpens_the_entire_mission_and_refuses_unknown_options(mission):
    done = CliRunner().invoke(
        app, ["pansharpen", str(mission.path), "--bits", "8", "--json", "--processes", "0"]
    )
    assert done.exit_code == 0, done.output
    output = json.loads(done.stdout)
    assert [row["exposure"] for row in output["exposures"]] == [1, 2, 3]
    assert all(set(row["files"]) == {"rgb-8.tif", "cir-8.tif"} for row in output["exposures"])
    with pytest.raises(ConfigurationError, match="--image is rgb or cir"):
        CliRunner().invoke(app, ["pansharpen", str(mission.path), "--image", "x"],
                           catch_exceptions=False)  # fmt: skip


@pytest.mark.trust
def test_processes_write_the_same_bytes(mission):
    command = ["pansharpen", str(mission.path), "--bits", "8", "--json"]
    hashes = []
    for count in ("0", "2"):
        done = CliRunner().invoke(app, [*command, "--processes", count])
        assert done.exit_code == 0, done.output
        hashes.append([path.read_bytes() for path in sorted(mission.path.rglob("L3/*/*.tif"))])
    assert hashes[0] == hashes[1] and len(hashes[0]) == 6


def test_a_missing_band_is_reported_and_leaves_out_its_images(mission):
    _, pan, colour = scene(RATIO)
    colour = {name: band[:100].copy() for name, band in colour.items()}
    colour["nir"][:] = 0
    write_level2(mission, 1, pan[:300], colour)
    _, (done,) = developed(mission, numbers=(1,))
    assert set(done.files) == {"rgb-16.tif", "rgb-8.tif"}
    assert done.left_out == ("cir: no nir at Level-2",)


def test_missing_or_damaged_level_2_is_reported_with_its_cure(mission):
    (mission.level2(3) / "pan.tif").unlink()
    with pytest.raises(level3.Level3Error, match=r"exposure 3: has no pan\.tif.*syntopic process"):
        developed(mission, numbers=(3,))
    _, pan, colour = scene(RATIO)
    write_level2(mission, 3, pan[:270], {name: band[:100] for name, band in colour.items()})
    with pytest.raises(level3.Level3Error, match=r"exposure 3: red is uint16.*process it again"):
        developed(mission, numbers=(3,))
    for number in (1, 2, 3):
        (mission.level2(number) / "rgbn.tif").unlink()
    with pytest.raises(level3.Level3Error, match="no exposure has colour"):
        developed(mission)


@pytest.mark.trust
@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (lambda m: (m.level2(1) / "rgbn.tif").write_bytes(b"II*\0"), "rgbn.tif cannot be read"),
        (lambda m: (m.level2(1) / "rgbn.tif").write_bytes(b""), "rgbn.tif cannot be read"),
        (lambda m: truncate(m.level2(1) / "rgbn.tif"), "cannot be read"),
        (lambda m: truncate(m.level2(1) / "pan.tif"), "cannot be read"),
        (lambda m: as_folder(m.level2(1) / "rgbn.tif"), "Is a directory"),
        (lambda m: as_folder(m.level2(1) / "pan.tif"), "Is a directory"),
        (lambda m: (m.level0(1) / "exposure.json").write_text("{"), "not a JSON record"),
        (lambda m: (m.level0(1) / "exposure.json").write_text('{"number": "1"}'), "whole number"),
    ],
)
def test_the_command_goes_on_after_an_exposure_it_cannot_develop(mission, damage, cause):
    damage(mission)
    done = CliRunner().invoke(
        app, ["pansharpen", str(mission.path), "--bits", "8", "--json", "--processes", "0"]
    )
    assert done.exit_code == 1
    output = json.loads(done.stdout)
    assert [row["exposure"] for row in output["exposures"]] == [2, 3]
    (failure,) = output["failures"]
    assert failure["exposure"] == 1 and cause in failure["cause"]
    assert "1 exposure failed" in done.stderr and "1 " in done.stderr
    assert sorted(p.name for p in (mission.path / "L3").iterdir()) == [
        "000002", "000003", "tone-curve.json",
    ]  # fmt: skip


@pytest.mark.trust
def test_develop_is_refused_while_another_process_writes_into_the_mission(mission):
    with mission.held(), pytest.raises(MissionError, match=r"held by another process: `.*`, proc"):
        CliRunner().invoke(app, ["pansharpen", str(mission.path)], catch_exceptions=False)
    assert not (mission.path / "L3").exists()


def truncate(path):
    path.write_bytes(path.read_bytes()[:5000])


def as_folder(path):
    path.unlink()
    path.mkdir()
