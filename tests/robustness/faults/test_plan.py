"""Faults as they are written: on the command line and in scenario files."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_hw.faults.catalogue import CATALOGUE, HEAD, RECEIVER, THERMOMETER, TRIGGER, DeviceKind
from sim_hw.faults.plan import FaultPlanError, PlannedFault, read_plan

DEVICES: dict[str, DeviceKind] = {
    "SU00": HEAD,
    "SU01": HEAD,
    "receiver": RECEIVER,
    "probes": THERMOMETER,
    "trigger": TRIGGER,
}
NAMES = (
    "lost late duplicate reordered corrupt truncated stuck silent flooding counter-reset "
    "clock-step clock-drift wrong-week cable-pulled power-cycle older-frame half-frame open-sensor"
)


def test_every_fault_has_its_name() -> None:
    assert list(CATALOGUE) == NAMES.split()


def test_a_fault_is_written_as_name_time_device_and_duration() -> None:
    (fault,) = read_plan(["silent@12.5:SU01,4"], None, DEVICES)
    assert fault == PlannedFault("silent", "SU01", 12.5, None, 4.0, 0.0)


def test_a_fault_may_begin_with_a_pulse_and_hit_one_kind_of_message() -> None:
    (fault,) = read_plan(["lost@#3:receiver/mark"], None, DEVICES)
    assert fault == PlannedFault("lost", "receiver", None, 3, None, 0.0, "mark")


def test_without_a_device_all_that_can_have_it_do() -> None:
    assert [f.device for f in read_plan(["half-frame@1"], None, DEVICES)] == ["SU00", "SU01"]
    assert [f.device for f in read_plan(["lost@1"], None, DEVICES)] == list(DEVICES)
    assert [f.device for f in read_plan(["open-sensor@1"], None, DEVICES)] == ["probes"]


def test_a_scenario_adds_to_the_plan(tmp_path: Path) -> None:
    scenario = tmp_path / "night.toml"
    scenario.write_text(
        '[[fault]]\nfault = "late"\nat_s = 3\nby_s = 0.7\ndevice = "receiver/mark"\n'
        '[[fault]]\nfault = "wrong-week"\nat_pulse = 9\nduration_s = 30.0\nweeks = 1\n'
    )
    late, week = read_plan([], scenario, DEVICES)
    assert late == PlannedFault("late", "receiver", 3, None, None, 0.7, "mark")
    assert week == PlannedFault("wrong-week", "receiver", None, 9, 30.0, 1.0)


def test_all_mistakes_are_reported_together_each_with_its_cure(tmp_path: Path) -> None:
    scenario = tmp_path / "wrong.toml"
    scenario.write_text(
        "colour = 1\n"
        '[[fault]]\nfault = "lots"\nat_s = 1\n'
        '[[fault]]\nfault = "lost"\nat_s = -1\nduration_s = 0\nby_s = 2\n'
        '[[fault]]\nfault = "late"\nat_s = 1\nat_pulse = 2\nby_s = 0\n'
        '[[fault]]\nfault = "wrong-week"\nat_pulse = 0\nweeks = 0.5\ndevice = "SU00"\n'
        '[[fault]]\nfault = "silent"\nat_s = true\ndevice = 5\n'
    )
    texts = ["lost", "lost@x", "open-sensor@3:SU00", "lost@3:SU09", "clock-step@3:receiver/mark"]
    texts += ["flooding@3:receiver/mark", "lost@3:receiver/marks", "lost@3:SU00/mark"]
    with pytest.raises(FaultPlanError) as caught:
        read_plan(texts, scenario, DEVICES)
    problems = caught.value.problems
    expected = [
        "--fault lost: write NAME@TIME[:DEVICE][,DURATION]",
        "--fault lost@x.at_s is 'x'; seconds from the start",
        "SU00 is a head, which cannot have open-sensor; it can be had by probes",
        "there is no device 'SU09'; lost can be had by SU00, SU01",
        "clock-step is of the whole device; leave out /mark",
        "flooding is of the whole device; leave out /mark",
        "receiver/marks is not a message; write receiver/mark or receiver/navigation",
        "SU00/mark is not a message; write SU00",
        "wrong.toml: colour is unknown",
        "wrong.toml: fault[0]: there is no fault 'lots'; did you mean lost?",
        "wrong.toml: fault[1].by_s is not known; lost has at_pulse, at_s, device",
        "wrong.toml: fault[1].at_s is -1",
        "wrong.toml: fault[1].duration_s is 0; a number of seconds above 0",
        "wrong.toml: fault[2]: give at_s, seconds from the start, or at_pulse, one of them",
        "wrong.toml: fault[2].by_s is 0",
        "wrong.toml: fault[3].at_pulse is 0; the number of a pulse, from 1",
        "wrong.toml: fault[3].weeks is 0.5; a whole number of weeks",
        "wrong.toml: fault[3]: SU00 is a head, which cannot have wrong-week",
        "wrong.toml: fault[4].at_s is True",
        "wrong.toml: fault[4].device is 5",
    ]
    assert len(problems) == len(expected), problems
    for problem, part in zip(problems, expected, strict=True):
        assert part in problem


@pytest.mark.parametrize(
    ("content", "expected"),
    [("", "there is no [[fault]]"), ("fault = 3", "there is no [[fault]]"), ("[[", "not valid")],
)
def test_a_file_that_is_no_scenario_is_refused(tmp_path: Path, content: str, expected: str) -> None:
    scenario = tmp_path / "s.toml"
    scenario.write_text(content)
    with pytest.raises(FaultPlanError, match=r"s\.toml") as caught:
        read_plan([], scenario, DEVICES)
    assert expected in str(caught.value)
    with pytest.raises(FaultPlanError, match="cannot be read"):
        read_plan([], tmp_path / "none.toml", DEVICES)
