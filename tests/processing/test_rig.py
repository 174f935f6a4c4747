"""Rig files are taken as they say, or refused with every mistake named at once."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

import pytest

from processing.rig import RigError, find_rig, load_rig, rig_from_mapping, shipped_rigs


def content(name: str = "ultracam-x-mini") -> dict[str, Any]:
    return tomllib.loads(shipped_rigs()[name].read_text())


def problems_of(changed: dict[str, Any]) -> tuple[str, ...]:
    with pytest.raises(RigError) as refused:
        rig_from_mapping(changed, "camera.toml")
    return refused.value.problems


@pytest.mark.parametrize("name", sorted(shipped_rigs()))
def test_every_shipped_rig_loads_and_is_called_what_its_file_is(name: str) -> None:
    rig = find_rig(name)
    assert rig.name == name
    assert rig.sensors and rig.cone(rig.reference_cone)
    assert rig.master_sensors or rig.has_virtual_camera or rig.virtual_image is None


def test_ultracam_x_is_thirteen_sensors_in_eight_cones_over_one_virtual_image() -> None:
    rig = find_rig("ultracam-x")
    assert [len(cone.sensors) for cone in rig.pan_cones] == [4, 2, 2, 1]
    assert len(rig.colour_cones) == 4
    image = rig.virtual_image
    assert image is not None
    assert (image.width_px, image.height_px) == (3 * 4992 - 2 * 273, 3 * 3328 - 2 * 282)
    forward = [cone.position_mm[0] for cone in rig.pan_cones]
    assert sorted(forward) == [-120.0, -40.0, 40.0, 120.0]


def test_the_mini_drifts_by_as_many_pixels_as_the_full_rig() -> None:
    full, mini = find_rig("ultracam-x"), find_rig("ultracam-x-mini")
    for name in ("SU00", "SU01", "SU02", "SU03"):
        drift_full, drift_mini = full.sensor(name).drift, mini.sensor(name).drift
        assert drift_mini.x_um_per_k == pytest.approx(drift_full.x_um_per_k, abs=0.2)
        assert drift_mini.y_um_per_k == pytest.approx(drift_full.y_um_per_k, abs=0.2)


def test_all_mistakes_are_named_at_once_with_file_key_value_and_cure() -> None:
    changed = content()
    changed["cone"][1]["sensor"][0]["pitch_um"] = -7.2
    changed["timing"] = "sometimes"
    changed["cone"][0]["lens"]["f_mm"] = "long"
    changed["colour_master_cone"] = "Q"
    del changed["calibration"]["date"]
    changed["cone"][2]["sensor"][1]["pitch"] = 7.2
    problems = problems_of(changed)
    assert len(problems) == 6, problems
    assert "camera.toml: cone[1].sensor[0].pitch_um is -7.2; it is at least 0.1" in problems
    for key in (
        "timing is 'sometimes'",
        "cone[0].lens.f_mm is 'long'",
        "colour_master_cone is 'Q'",
        "calibration.date is missing",
        "cone[2].sensor[1].pitch is not a known key",
    ):
        assert any(key in problem for problem in problems), key


@pytest.mark.parametrize("value", [float("nan"), float("inf"), True, [1.0], "7"])
def test_a_number_that_is_none_is_refused(value: object) -> None:
    changed = content()
    changed["cone"][0]["sensor"][0]["x_mm"] = value
    (problem,) = problems_of(changed)
    assert "cone[0].sensor[0].x_mm" in problem


def test_perspective_skew_is_optional_and_within_reason() -> None:
    changed = content()
    first, second = changed["cone"][0]["sensor"][:2]
    first["skew_x_ppm_per_mm"] = -3.5
    rig = rig_from_mapping(changed, "rig.toml")
    assert rig.sensors[0].skew_per_mm == pytest.approx((-3.5e-6, 0.0))
    assert rig.sensors[1].skew_per_mm == (0.0, 0.0)
    first["skew_y_ppm_per_mm"], second["skew_x_ppm_per_mm"] = 1001.0, "much"
    problems = problems_of(changed)
    assert len(problems) == 2
    assert "cone[0].sensor[0].skew_y_ppm_per_mm is 1001.0; it is at most 1000" in problems[0]


def test_two_sensors_of_one_name_are_refused() -> None:
    changed = content()
    changed["cone"][0]["sensor"][1]["name"] = "SU00"
    (problem,) = problems_of(changed)
    assert "SU00" in problem and "unique" in problem


def test_what_is_no_rig_file_is_refused_in_one_sentence(tmp_path: Path) -> None:
    broken = tmp_path / "camera.toml"
    broken.write_bytes(b"\xff\xfe[cone")
    huge = tmp_path / "huge.toml"
    huge.write_bytes(b"#" * 1_100_000)
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    endless = tmp_path / "endless.toml"
    endless.symlink_to("/dev/zero")
    for path in (broken, huge, tmp_path / "absent.toml", pipe, endless):
        with pytest.raises(RigError) as refused:
            load_rig(path)
        assert len(refused.value.problems) == 1
    with pytest.raises(RigError, match="ultracam-x-mini"):
        find_rig("ultracam-y")


def test_probes_have_serial_numbers_of_their_own_and_only_those_of_the_rig() -> None:
    changed = content()
    changed["probe_serials"] = {"0": "PT-17"}
    changed["cone"][0]["lens"]["serial"] = "L-1"
    rig = rig_from_mapping(changed, "rig.toml")
    parts = rig.serials
    assert parts["probe 0"] == "PT-17" and parts[f"lens {rig.cones[0].name}"] == "L-1"
    assert parts["SU00"] == rig.sensor("SU00").serial
    assert "probe 1" not in parts
    changed["probe_serials"] = {"boiler": "PT-18"}
    assert "probe_serials.boiler" in problems_of(changed)[0]


def changed_rig(tmp_path: Path, before: str, after: str) -> Path:
    text = shipped_rigs()["ultracam-x-mini"].read_text()
    assert before in text
    path = tmp_path / "rig.toml"
    path.write_text(text.replace(before, after, 1))
    return path


@pytest.mark.trust
@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ("width_px =", "width_px = 1000000000 #", "it is at most 65535"),
        (
            "width_px = 3480\nheight_px = 2226",
            "width_px = 65535\nheight_px = 65535",
            "width_px times height_px is",
        ),
        ("f_mm", "f_mm = 1e-300 # ", "it is at least 0.1"),
        ("pitch_um", "pitch_um = 1e9 # ", "it is at most 1000"),
        ("frame_interval_s", "frame_interval_s = inf # ", "a finite number"),
        ("frame_interval_s", f"frame_interval_s = 1{'0' * 400} # ", "a finite number"),
        ("colour_ratio", "colour_ratio = 0.001 # ", "colour image"),
        ("colour_ratio", "colour_ratio = 1e9 # ", "colour image"),
        (
            "position_mm",
            f"position_mm = [0, 0, 1{'0' * 400}] # ",
            r"position_mm\[2\] is 1000.*; a finite number",
        ),
        ('name = "SU00"', 'name = "../../SU00"', "letters, digits"),
        ('name = "SU00"', 'name = "SU00\\u001b[2J"', "letters, digits"),
        ('serial = "', 'serial = "\\u202e', "are all visible"),
        ("title", "title = '" + "x" * 5000 + "' # ", "1000 characters"),
    ],
)
def test_a_value_that_no_camera_has_is_refused(
    tmp_path: Path, before: str, after: str, sentence: str
) -> None:
    with pytest.raises(RigError, match=sentence) as refused:
        load_rig(changed_rig(tmp_path, before, after))
    assert max(map(len, refused.value.problems)) < 500


@pytest.mark.parametrize(
    "data",
    [
        b"a = " + b"[" * 100_000,
        b"a = " + b"[" * 500 + b"]" * 500,
        b".".join([b"a"] * 5_000) + b" = 1",
        b"a = 1" + b"0" * 5_000,
        b"a = '\xff'",
        b"\xff\xfea\0=\0001\0",
    ],
)
def test_toml_that_costs_more_than_its_size_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "rig.toml").write_bytes(data)
    with pytest.raises(RigError, match="not valid TOML"):
        load_rig(tmp_path / "rig.toml")


def test_a_sentence_names_the_line_of_the_key(tmp_path: Path) -> None:
    path = changed_rig(tmp_path, "pitch_um = ", "pitch_um = -")
    (line,) = (
        number
        for number, text in enumerate(path.read_text().splitlines(), start=1)
        if text.startswith("pitch_um = -")
    )
    with pytest.raises(RigError, match=rf"^rig\.toml:{line}: virtual_image\.pitch_um is -"):
        load_rig(path)


def test_a_mistake_in_the_defaults_is_named_once_where_it_is(tmp_path: Path) -> None:
    changed = content()
    assert "bits" in changed["defaults"]["sensor"]
    changed["defaults"]["sensor"]["bits"] = 17
    changed["defaults"]["lens"]["f_no"] = 5.6
    changed["defaults"]["lens"]["direction"] = "measured_from_ideal"
    assert sorted(problems_of(changed)) == [
        "camera.toml: defaults.lens.direction is 'measured_from_ideal'; a lens correction here is "
        "ideal_from_measured",
        "camera.toml: defaults.lens.f_no is not a known key; check the spelling",
        "camera.toml: defaults.sensor.bits is 17; it is at most 16",
    ]
    changed = content()
    changed["cone"][0]["sensor"][1]["bits"] = 17
    assert problems_of(changed) == ("camera.toml: cone[0].sensor[1].bits is 17; it is at most 16",)


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("cone", [], "camera.toml: cone is []; it has 1 entries at least"),
        ("cone", content()["cone"] * 9, "it has 64 entries at most"),
        ("cone", [3], "camera.toml: cone[0] is 3; a table is needed"),
        ("cone", "eight", "camera.toml: cone is 'eight'; a list is needed"),
        ("format", 2, "camera.toml: format is 2; it is one of 1"),
        ("calibration", {"id": "a", "date": "2024-02-30"}, "calibration.date is '2024-02-30'"),
        ("virtual_image", {}, "camera.toml: virtual_image.width_px is missing; it is needed"),
        ("defaults", {"lense": {}}, "camera.toml: defaults.lense is not a known key"),
    ],
)
def test_what_has_not_the_form_of_a_rig_is_refused(key: str, value: object, sentence: str) -> None:
    assert any(sentence in problem for problem in problems_of(content() | {key: value}))


def test_the_colour_image_has_whole_pixels_at_a_broken_ratio() -> None:
    changed = content()
    image = changed["virtual_image"]
    image |= {"width_px": 3480, "height_px": 2220, "colour_ratio": 2.5}
    assert rig_from_mapping(changed, "rig.toml").virtual_image is not None
    image["height_px"] = 2221
    (problem,) = problems_of(changed)
    assert "height_px is no multiple of a colour_ratio of 2.5" in problem
