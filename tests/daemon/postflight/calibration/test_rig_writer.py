"""A rig written as a file is read back as the same rig."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import pytest

from daemon.postflight.calibration.rig_writer import rig_toml
from processing.rig import RigError, find_rig, load_rig, rig_from_mapping, shipped_rigs


@pytest.mark.parametrize("name", sorted(shipped_rigs()))
def test_every_shipped_rig_survives_writing_and_reading(name):
    rig = load_rig(shipped_rigs()[name])
    text = rig_toml(rig, remark="a remark\nof two lines").decode()
    assert text.startswith("#:schema ./rig.schema.json\n# a remark\n# of two lines\n")
    assert rig_from_mapping(tomllib.loads(text), "rig.toml") == rig


def test_serial_numbers_of_probes_survive_it_too():
    rig = load_rig(shipped_rigs()["ultracam-x-mini"])
    rig = replace(rig, probe_serials={"0": "PT-17", "N": 'PT "18"'})
    assert rig_from_mapping(tomllib.loads(rig_toml(rig).decode()), "rig.toml") == rig


def test_left_justified_words_are_refused_where_images_are_stitched():
    content = tomllib.loads(rig_toml(load_rig(shipped_rigs()["ultracam-x-mini"])).decode())
    content["cone"][0]["sensor"][0]["justified"] = "left"
    with pytest.raises(RigError, match=r"sensor\[0\]\.justified is 'left'"):
        rig_from_mapping(content, "rig.toml")
    rig = load_rig(shipped_rigs()["rededge"])
    assert {sensor.raw_units_per_dn for sensor in rig.sensors} == {16}
    assert rig.probes == ()


def test_the_first_line_names_the_schema_unless_the_file_is_a_record() -> None:
    rig = find_rig("rededge")
    assert rig_toml(rig, remark="A\nB").splitlines()[:3] == [
        b"#:schema ./rig.schema.json", b"# A", b"# B",
    ]  # fmt: skip
    assert rig_toml(rig, names_schema=False).startswith(b"format")
