"""The devices a configuration asks for, held against the rig."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

from daemon.configuration.model import Configuration
from daemon.onboard.capture.devices import (
    device_specs,
    exposure_times_ns,
    frame_nbytes,
    serial_problem,
    stated_serial_problems,
)
from daemon.onboard.preflight.service_file import from_mapping
from processing.rig import Rig, find_rig
from tests.daemon.configuration.test_configuration import GOOD


def configured(**head: object) -> tuple[Configuration, Rig]:
    content = copy.deepcopy(GOOD)
    content["head"][0] |= head
    return from_mapping(content, Path("service.toml"))


def test_a_head_with_another_serial_number_than_the_calibration_is_refused_with_both() -> None:
    rig = find_rig("ultracam-x-mini")
    assert serial_problem(rig, "SU00", {"serial": "M-SU00"}) is None
    assert serial_problem(rig, "SU00", {}) is None, "a head without a serial number is no problem"
    sentence = serial_problem(rig, "SU00", {"serial": "M-SU01"})
    assert sentence is not None
    assert "M-SU00" in sentence and "M-SU01" in sentence and "connect" in sentence


def test_a_lens_or_probe_other_than_the_calibrated_one_is_reported_with_both_serials() -> None:
    content = copy.deepcopy(GOOD)
    content["serials"] = {"lens": {"0": "L-2"}, "probe": {"0": "PT-17", "1": "PT-19"}}
    configuration, rig = from_mapping(content, Path("service.toml"))
    cone = rig.cone("0")
    lens = replace(cone.lens, serial="L-1")
    cones = tuple(replace(c, lens=lens) if c is cone else c for c in rig.cones)
    # The calibration has no serial number of probe 1.
    made = replace(rig, cones=cones, probe_serials={"0": "PT-17"})
    (sentence,) = stated_serial_problems(configuration, made)
    assert "lens 0" in sentence and "'L-2'" in sentence and "'L-1'" in sentence
    assert stated_serial_problems(configuration, rig) == []


def test_a_head_knows_its_output_and_the_trigger_comes_last() -> None:
    configuration, rig = configured()
    specs = device_specs(configuration, rig)
    assert [(spec.kind, spec.name, spec.output) for spec in specs] == [
        ("head", "SU00", "0"),
        ("thermometer", "probes", ""),
        ("navigator", "gnss", ""),
        ("trigger", "trigger", ""),
    ]
    assert specs[0].settings == {"address": "127.0.0.2"}


def test_exposure_times_are_those_of_the_heads_by_cone() -> None:
    configuration, rig = configured(exposure_time_us=3907.7)
    times_ns = exposure_times_ns(configuration, rig)
    assert times_ns["0"] == 3_907_700
    assert times_ns["G"] == 0


def test_a_slot_holds_the_pixels_and_what_a_head_appends() -> None:
    rig = find_rig("ultracam-x")
    assert frame_nbytes(rig, "SU00") >= 4992 * 3328 * 2 + 64
