"""docs/reference/formats.md is exact: its example runs, and it names every key."""

from __future__ import annotations

import re
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import pytest

from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.exposure import Exposure, NavigationRecord, capture_bytes, from_json, to_json
from daemon.mission.layout import Mission
from daemon.mission.store.store import load_level0, verify
from processing.quality.figures import FIGURES
from processing.quality.report import Flag, Thresholds
from processing.rig import Cone, Lens, Rig, Sensor, ThermalDrift, VirtualImage, load_rig
from tests.daemon.small_camera import (
    HEIGHT_PX,
    RIG_TOML,
    SENSORS,
    WIDTH_PX,
    capture_of,
    final_record,
    pixels_of,
    small_rig,
)

PAGE = Path(__file__).parents[2] / "docs/reference/formats.md"


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text(encoding="utf-8")


def named(page, heading, end="\n## "):
    """Everything in backquotes below a heading."""
    body = page.split(f"{heading}\n", 1)[1].split(end, 1)[0]
    return set(re.findall(r"`([^`\n]+)`", body))


@pytest.fixture
def by_hand(page, tmp_path, monkeypatch):
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "docs/reference/formats.md", "exec"), {})
    return Mission.open(tmp_path / "by-hand")


def test_the_example_is_an_exposure_that_can_be_processed(by_hand):
    rig = load_rig(by_hand.rig_path)
    assert by_hand.numbers() == [1]
    frames, exposure = load_level0(by_hand.level0(1), rig)
    assert list(frames) == [sensor.name for sensor in rig.sensors]
    assert all(np.all(pixels == 1000) for pixels in frames.values())
    assert exposure.state == "complete" and exposure.missing == ()
    assert exposure.mark_gps_ns == 1_447_000_001_000_000_000
    assert {t.probe for t in exposure.temperatures} == set(rig.probes)
    assert exposure.frame("SU11").settings == {"TdiShifts": 12}
    assert exposure.frame("SU11").width_px == 1248
    assert verify(by_hand).problems == ()


def test_without_a_record_the_frames_are_taken_as_they_are(by_hand):
    rig = load_rig(by_hand.rig_path)
    (by_hand.level0(1) / "exposure.json").unlink()
    (by_hand.level0(1) / "SU30.tif").unlink()
    frames, exposure = load_level0(by_hand.level0(1), rig)
    assert len(frames) == 12
    assert exposure.state == "degraded"
    assert exposure.missing == (("SU30", "no frame in the folder"),)
    assert exposure.temperatures == () and exposure.number == 1


def test_a_listed_frame_without_its_file_is_a_missing_frame(by_hand):
    (by_hand.level0(1) / "G.tif").unlink()
    frames, exposure = load_level0(by_hand.level0(1), load_rig(by_hand.rig_path))
    assert "G" not in frames
    assert exposure.missing == (("G", "G.tif is not in its folder"),)


@pytest.mark.trust
def test_a_frame_with_another_suffix_is_taken_or_its_name_corrected(by_hand):
    folder, rig = by_hand.level0(1), load_rig(by_hand.rig_path)
    (folder / "SU30.tif").rename(folder / "SU30.TIF")
    with pytest.raises(RecordError, match=r"SU30\.TIF: the record names it SU30\.tif; rename"):
        load_level0(folder, rig)
    (folder / "exposure.json").unlink()
    frames, exposure = load_level0(folder, rig)
    assert exposure.state == "complete" and exposure.frame("SU30").file == "SU30.TIF"
    assert len(frames) == 13


def test_every_key_of_the_records_is_named(page):
    output = named(page, "## exposure.json and capture.json")
    record = to_json(final_record(capture_of(1)))
    written = set(record) | set(record["frames"][0]) | {"sensor", "cause", "probe", "value_c"}
    written |= {field.name for field in fields(NavigationRecord)}
    single = {word for text in output for word in re.findall(r"[a-z_0-9]+", text)}
    assert written - single == set()


def test_the_keys_of_a_capture_are_those_marked(page):
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| c \|", page, re.MULTILINE)
    marked = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert marked == set(parse_record(capture_bytes(capture_of(1)), "capture.json"))


def test_the_documented_defaults_are_the_defaults_used(page):
    taken = to_json(from_json({"number": 1}))
    output = dict(re.findall(r"^\| `(\w+)` \|(?: c)? ?\|.*\| ([^|]+) \|$", page, re.MULTILINE))
    for key, default in (
        ("trigger_sequence", 0),
        ("trigger_mono_ns", '`"0"`'),
        ("boot_id", '`""`'),
        ("mark_gps_ns", "null"),
        ("mark_source", "`none`"),
        ("navigation", "null"),
        ("simulated", "false"),
        ("flags", 0),
    ):
        assert output[key] == str(default)
        plain = str(default).strip("`").strip('"')
        assert str(taken[key]).replace("None", "null").replace("False", "false") == (
            "null" if plain == "null" else plain
        )
    assert Exposure(number=1).state == "complete"


def test_every_threshold_is_named_with_its_default(page):
    table = page.partition("| threshold |")[2].split("\n\n")[0].splitlines()
    output = {}
    for row in (line.split("|") for line in table[2:]):
        values = row[3].split("(")[0].split(",")
        output |= dict(zip(re.findall(r"`(\w+)`", row[1]), map(float, values), strict=True))
    assert output == pytest.approx(asdict(Thresholds()), rel=1e-3)


def test_every_figure_and_every_flag_is_named_with_its_meaning_and_place(page):
    for name, meaning in FIGURES.items():
        assert f"| `{name}` | {meaning} |" in page
    bits = {name: int(bit) for bit, name in re.findall(r"\| (\d+) \| `([A-Z0-9_]+)`", page)}
    assert bits == {flag.name: flag.value.bit_length() - 1 for flag in Flag}


def test_every_key_of_a_rig_file_is_named(page):
    output = {w for text in named(page, "## Rig files") for w in re.findall(r"[a-z_0-9]+", text)}
    keys = {
        field.name
        for kind in (Rig, VirtualImage, Cone, Lens, Sensor, ThermalDrift)
        for field in fields(kind)
    }
    keys -= {"calibration_id", "calibration_date", "calibration_valid_days"}
    keys -= {"cones", "sensors", "lens", "drift"}
    assert keys - output == set()


def test_a_hand_written_exposure_with_mistakes_is_refused_with_all_of_them(tmp_path):
    import tifffile

    from daemon.mission.canonical_json import RecordError

    folder = tmp_path / "m" / "L0" / "000001"
    folder.mkdir(parents=True)
    (tmp_path / "m" / "rig.toml").write_text(RIG_TOML)
    pixels = pixels_of(1)
    tifffile.imwrite(folder / "SU00.tif", pixels["SU00"][:10])
    tifffile.imwrite(folder / "SU01.tif", pixels["SU01"].astype(np.uint8))
    (folder / "SU10.tif").write_bytes(b"II*\0 not really")
    with pytest.raises(RecordError) as caught:
        load_level0(folder, small_rig())
    assert len(caught.value.problems) == len(SENSORS)
    assert f"64 x 10 px; the sensor has {WIDTH_PX} x {HEIGHT_PX} px" in caught.value.problems[0]
    assert "holds uint8" in caught.value.problems[1]
    assert "not a usable TIFF" in caught.value.problems[2]
    (folder / "exposure.json").write_text('{"number": 2}')
    with pytest.raises(RecordError, match="number is 2; the folder is 000001"):
        load_level0(folder, small_rig())
