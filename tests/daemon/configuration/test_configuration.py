"""An invalid configuration is refused with all its errors; a valid one is read as written."""

from __future__ import annotations

import copy
import os
from pathlib import Path
from typing import Any

import pytest

from daemon.configuration.model import ConfigurationError
from daemon.onboard.preflight.service_file import from_mapping, load

GOOD: dict[str, Any] = {
    "mission": {"root": "missions", "rig": "ultracam-x-mini"},
    "trigger": {"driver": "pulse-bus", "port": 5310, "interval_s": 2.0},
    "head": [{"sensor": "SU00", "driver": "aravis", "address": "127.0.0.2"}],
    "thermometer": [
        {"name": "probes", "driver": "modbus-rtu", "port": "/dev/ttyS1", "channels": ["0"]}
    ],
    "navigator": [{"name": "gnss", "driver": "ublox", "port": "/dev/ttyS2"}],
}
FILE = Path("service.toml")


def problems_of(content: dict[str, Any]) -> tuple[str, ...]:
    with pytest.raises(ConfigurationError) as refused:
        from_mapping(content, FILE)
    return refused.value.problems


def test_a_valid_configuration_resolves_paths_relative_to_the_file(tmp_path: Path) -> None:
    configuration, rig = from_mapping(copy.deepcopy(GOOD), tmp_path / "service.toml")
    assert rig.name == "ultracam-x-mini"
    assert configuration.mission.root == tmp_path / "missions"
    assert configuration.head[0].settings == {"address": "127.0.0.2"}
    assert configuration.limits.exposures_in_memory == 3


def test_five_mistakes_are_refused_with_five_sentences_that_name_file_and_key() -> None:
    content = copy.deepcopy(GOOD)
    content["trigger"]["interval_s"] = -2.0
    content["head"][0]["sensor"] = "SU99"
    content["navigator"][0]["driver"] = "ublocks"
    content["thermometer"][0]["parity"] = "X"
    content["processing"] = {"method": "freely"}
    problems = problems_of(content)
    assert len(problems) == 5, problems
    for key in (
        "trigger.interval_s",
        "head[0].sensor",
        "navigator[0].driver",
        "thermometer[0].parity",
        "processing.method",
    ):
        (sentence,) = [problem for problem in problems if key in problem]
        assert sentence.startswith("service.toml: ")
        assert "; " in sentence, "the correction follows the finding"


def test_a_distance_trigger_without_a_distance_is_refused() -> None:
    content = copy.deepcopy(GOOD)
    content["trigger"]["mode"] = "distance"
    (sentence,) = problems_of(content)
    assert "distance_m" in sentence


def test_a_threshold_is_taken_and_an_unknown_one_refused() -> None:
    content = copy.deepcopy(GOOD)
    content["processing"] = {"thresholds": {"sharpness": 0.3}}
    configuration, _ = from_mapping(content, Path("service.toml"))
    assert configuration.processing.thresholds == {"sharpness": 0.3}
    content["processing"] = {"thresholds": {"sharpnes": 0.3}}
    (sentence,) = problems_of(content)
    assert "processing.thresholds" in sentence and "sharpnes: no such threshold;" in sentence


def test_a_misspelt_key_is_refused_by_its_name() -> None:
    content = copy.deepcopy(GOOD)
    content["mission"]["simulatd"] = True
    (sentence,) = problems_of(content)
    assert "mission.simulatd" in sentence


@pytest.mark.parametrize(
    ("section", "old", "value", "new"),
    [
        ("exposure", "gain_most_db", 12.0, "gain_max_db"),
        ("exposure", "time_least_us", 100.0, "exposure_time_min_us"),
        ("exposure", "time_most_us", 20_000.0, "exposure_time_max_us"),
        ("exposure", "tdi_most", 32, "tdi_shifts_max"),
        ("processing", "exposures_in_work", 2, "parallel_exposures"),
        ("trigger", "start", "at once", "'immediate'"),
        ("watch", "open", True, "anonymous_read"),
    ],
)
def test_a_former_key_is_refused_with_the_present_one(
    section: str, old: str, value: Any, new: str
) -> None:
    content = copy.deepcopy(GOOD)
    content.setdefault(section, {})[old] = value
    (sentence,) = problems_of(content)
    assert old in sentence and f"is now named {new}; rename it" in sentence


def test_a_former_key_hides_no_other_mistake_of_its_section() -> None:
    content = copy.deepcopy(GOOD)
    content["exposure"] = {"gain_most_db": 12.0, "tdi_most": 32, "smear_px": 0, "target": "high"}
    assert problems_of(content) == (
        "service.toml: exposure.target is 'high'; a finite number is needed",
        "service.toml: exposure.smear_px is 0; it is more than 0",
        "service.toml: exposure.gain_most_db is now named gain_max_db; rename it",
        "service.toml: exposure.tdi_most is now named tdi_shifts_max; rename it",
    )


@pytest.mark.parametrize(
    ("section", "key", "value", "hint"),
    [
        ("watch", "port", "8470", "a whole number is needed"),
        ("watch", "anonymous_read", 1, "true or false is needed"),
        ("limits", "exposures_in_memory", 3.5, "a whole number is needed"),
        ("limits", "frame_timeout_s", True, "a finite number is needed"),
        ("limits", "frame_timeout_s", float("inf"), "a finite number is needed"),
        ("mission", "root", 5, "a path is needed"),
        ("mount", "antenna_m", "here", "a list is needed"),
        ("plan", "line", ["a"], "a text is needed"),
        ("exposure", "lock", "lines", "it is one of line, never"),
        ("watch", "hosts", ["a"] * 17, "it has 16 entries at most"),
    ],
)
def test_a_value_is_not_converted_to_the_type_of_its_key(
    section: str, key: str, value: Any, hint: str
) -> None:
    content = copy.deepcopy(GOOD)
    content.setdefault(section, {})[key] = value
    (sentence,) = problems_of(content)
    assert sentence.startswith(f"service.toml: {section}.{key} is ") and sentence.endswith(hint)


def test_sentences_name_the_lines_of_keys_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "service.toml"
    path.write_text(
        '[mission]\nroot = "m"\nrig = "ultracam-x-mini"\n\n[trigger]\ndriver = "software"\n'
        "# A list over several lines, and a table that is not there.\n"
        'interval_s = -1\n[[head]]\nsensor = "SU00"\ndriver = "folder"\nfolder = "f"\n'
        "[mount]\nantenna_m = [\n  0.0,\n  1.0,\n]\n[[navigator]]\nname = 'n'\n"
    )
    with pytest.raises(ConfigurationError) as refused:
        load(path)
    starts = [problem.split(" is ")[0] for problem in refused.value.problems]
    assert "service.toml:8: trigger.interval_s" in starts
    assert "service.toml:14: mount.antenna_m[2]" in starts
    assert "service.toml:18: navigator[0].driver" in starts


def test_a_former_threshold_is_refused_with_the_present_one() -> None:
    content = copy.deepcopy(GOOD)
    content["processing"] = {"thresholds": {"burnt_overlap_fraction": 0.1}}
    (sentence,) = problems_of(content)
    assert "is now named saturated_overlap_fraction; rename it" in sentence


def test_two_heads_for_one_sensor_are_refused() -> None:
    content = copy.deepcopy(GOOD)
    content["head"].append(dict(content["head"][0], address="127.0.0.3"))
    (sentence,) = problems_of(content)
    assert "head[1].sensor" in sentence


def test_a_probe_that_two_devices_read_is_refused() -> None:
    content = copy.deepcopy(GOOD)
    content["head"][0]["temperature_probe"] = "0"
    (sentence,) = problems_of(content)
    assert (
        "head[0].temperature_probe names the probe '0', as does thermometer[0].channels" in sentence
    )


def test_an_unknown_rig_is_refused_with_the_names_of_those_there_are() -> None:
    content = copy.deepcopy(GOOD)
    content["mission"]["rig"] = "ultracam-y"
    (sentence,) = problems_of(content)
    assert "ultracam-x-mini" in sentence


def test_a_file_that_is_not_toml_or_not_there_is_refused_in_one_sentence(tmp_path: Path) -> None:
    broken = tmp_path / "service.toml"
    broken.write_text("[mission\n")
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    for path in (broken, tmp_path / "absent.toml", pipe, Path("/dev/zero")):
        with pytest.raises(ConfigurationError) as refused:
            load(path)
        assert len(refused.value.problems) == 1


def test_tdi_on_a_bayer_head_is_refused_with_the_correction() -> None:
    content = copy.deepcopy(GOOD)
    content["mission"]["rig"] = "ultracam-l-mini"
    content["head"] = [
        {"sensor": "RGB", "driver": "aravis", "address": "127.0.0.2", "tdi_shifts": 12},
        {"sensor": "SU00", "driver": "aravis", "address": "127.0.0.3", "tdi_shifts": 12},
    ]
    (sentence,) = problems_of(content)
    assert sentence.startswith("service.toml: head[0].tdi_shifts is 12; RGB is a Bayer head (RGGB)")
    assert sentence.endswith("set 0 and expose shorter")


def test_a_plan_to_follow_has_to_be_there_and_readable(tmp_path: Path) -> None:
    content = copy.deepcopy(GOOD)
    content["trigger"] |= {"mode": "plan"}
    assert any("there is no plan.file" in problem for problem in problems_of(content))
    content["plan"] = {"file": "block.kml"}
    for text, why in ((None, "cannot be read"), ("<kml/>", "holds no line")):
        if text is not None:
            (tmp_path / "block.kml").write_text(text)
        with pytest.raises(
            ConfigurationError, match=rf"plan\.file cannot be used: .*block\.kml: {why}"
        ):
            from_mapping(content, tmp_path / "service.toml")


def test_parts_that_no_bus_reports_are_listed_and_only_those_of_the_rig() -> None:
    content = copy.deepcopy(GOOD)
    content["serials"] = {"lens": {"0": "L-1"}, "probe": {"0": "PT-17"}}
    configuration, _ = from_mapping(content, FILE)
    assert configuration.serials.parts == {"lens 0": "L-1", "probe 0": "PT-17"}
    content["serials"] = {"lens": {"9": "L-1"}, "probe": {"boiler": "PT-17"}}
    problems = problems_of(content)
    assert (
        len(problems) == 2
        and "serials.lens.9" in problems[0]
        and "serials.probe.boiler" in problems[1]
    )
    content["serials"] = {"lens": "L-1"}
    assert "serials.lens" in problems_of(content)[0]
