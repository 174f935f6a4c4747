"""The registry: which drivers there are, and that asking for them loads no hardware library."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from drivers.base import registry
from drivers.contract import DeviceError

EVERY_DRIVER = [(kind, name) for kind, names in registry.kinds().items() for name in names]


def test_there_are_the_drivers_of_the_first_flight() -> None:
    assert registry.kinds() == {
        "head": ("aravis", "folder", "v4l2"),
        "trigger": ("pulse-bus", "software", "gige-action"),
        "thermometer": ("modbus-rtu", "ascii-line", "host"),
        "pps": ("kernel",),
        "navigator": (
            "ublox",
            "gpsd",
            "nmea",
            "novatel",
            "septentrio",
            "sbg",
            "vectornav",
            "xsens",
            "applanix",
            "gsof",
            "mavlink",
        ),
    }


@pytest.mark.parametrize(("kind", "name"), EVERY_DRIVER)
def test_every_driver_knows_its_kind_and_explains_its_settings(kind: str, name: str) -> None:
    driver = registry.driver_for(kind, name)
    assert vars(driver)["kind"] == kind
    assert driver.__doc__
    for setting in driver.settings():
        assert setting.help, setting.name
        if not setting.required:
            assert setting.convert(setting.default) == setting.default, setting.name


def test_a_driver_that_does_not_exist_is_named_with_those_that_do() -> None:
    assert registry.problems("head", "basler", {}) == [
        "driver is 'basler'; a head has aravis, folder, v4l2"
    ]
    with pytest.raises(DeviceError, match="one of head, trigger, thermometer, pps, navigator"):
        registry.driver_for("barometer", "any")


def test_mistakes_of_an_entire_section_come_at_once() -> None:
    problems = registry.problems(
        "thermometer",
        "modbus-rtu",
        {"parity": "X", "channels": ["0", "1"], "unit": 0, "interval": 1},
    )
    assert [sentence.split()[0] for sentence in problems] == ["parity", "unit", "interval", "port"]


def test_settings_that_contradict_each_other_are_refused() -> None:
    section = {"port": "/dev/ttyUSB0", "channels": ["0", "0"], "interval_s": 10}
    assert registry.problems("thermometer", "modbus-rtu", section) == [
        "channels names 0 twice; every probe has its own name",
        "silence_s is 5; at least interval_s + answer_timeout_s = 10.5, or every pause is silence",
    ]
    assert registry.problems("head", "aravis", {"address": "127.88.0.1", "width_px": 640}) == [
        "width_px is 640 and height_px is 0; give both or neither"
    ]


def test_validating_every_driver_loads_no_hardware_library() -> None:
    code = (
        "import sys\n"
        "from drivers.base import registry\n"
        "for kind, names in registry.kinds().items():\n"
        "    for name in names: registry.problems(kind, name, {})\n"
        "print(sorted({'gi', 'numba', 'cv2', 'numpy', 'tifffile'} & set(sys.modules)))\n"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert answer.stdout.strip() == "[]"
