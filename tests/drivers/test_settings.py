"""Declared settings: defaults, types, and errors reported all at once."""

from __future__ import annotations

import pytest

from drivers.base import registry
from drivers.base.settings import FORMER_NAMES, Configured, Setting, SettingsError
from drivers.contract import DeviceError


class LampDevice(Configured):
    """A device for these tests."""

    brightness = Setting(50, minimum=0, maximum=100, help="brightness in percent")
    colour = Setting("white", choices=("white", "red"), help="colour of the light")
    warm_up_s = Setting(0.5, minimum=0, help="time until it is bright")
    steady = Setting(True, help="whether it burns steadily")
    sockets: Setting[tuple[str, ...]] = Setting(
        (), required=True, minimum=1, help="names of the sockets"
    )


class NavigationLamp(LampDevice):
    """Inherits, and changes one default."""

    colour = Setting("red", choices=("red",), help="colour prescribed")


def test_a_setting_that_is_not_given_has_its_default() -> None:
    lamp = LampDevice("nose", {"sockets": ["a"]})
    assert (lamp.brightness, lamp.colour, lamp.warm_up_s, lamp.steady) == (50, "white", 0.5, True)
    assert lamp.sockets == ("a",)
    assert lamp.name == "nose"


def test_an_integer_will_do_where_a_float_is_meant() -> None:
    lamp = LampDevice("nose", {"sockets": ["a"], "warm_up_s": 2})
    assert lamp.warm_up_s == 2.0
    assert isinstance(lamp.warm_up_s, float)


def test_the_class_lists_its_settings_with_type_default_choices_and_sentence() -> None:
    listed = {s.name: (s.type_name, s.default, s.choices, s.help) for s in LampDevice.settings()}
    assert listed["colour"] == ("a text", "white", ("white", "red"), "colour of the light")
    assert listed["brightness"] == ("a whole number", 50, (), "brightness in percent")
    assert list(listed) == ["brightness", "colour", "warm_up_s", "steady", "sockets"]


def test_a_subclass_may_redeclare_a_setting() -> None:
    assert NavigationLamp("left", {"sockets": ["a"]}).colour == "red"
    assert len(NavigationLamp.problems({"sockets": ["a"], "colour": "white"})) == 1


def test_five_mistakes_give_five_sentences_each_with_key_value_and_cure() -> None:
    problems = LampDevice.problems(
        {"brightness": 300, "colour": "blue", "warm_up_s": "long", "steady": 1, "brigthness": 3}
    )
    assert problems == [
        "brightness is 300; at most 100 (brightness in percent)",
        "colour is 'blue'; one of 'white', 'red' (colour of the light)",
        "warm_up_s is 'long'; a finite number is needed (time until it is bright)",
        "steady is 1; true or false is needed (whether it burns steadily)",
        "brigthness is 3; there is no such setting, brightness is meant?",
        "sockets is missing; a list of names is needed (names of the sockets)",
    ]


def test_a_device_with_wrong_settings_is_not_created() -> None:
    with pytest.raises(SettingsError) as caught:
        LampDevice("nose", {"brightness": True})
    assert isinstance(caught.value, DeviceError)
    assert len(caught.value.problems) == 2
    assert str(caught.value).startswith("nose: brightness is True")


@pytest.mark.parametrize("value", ["a", [], [""], [1], None, {"a": 1}])
def test_a_list_of_names_holds_texts(value: object) -> None:
    assert len(LampDevice.problems({"sockets": value})) == 1


@pytest.mark.parametrize("value", [float("nan"), float("inf"), True, None, "1"])
def test_a_number_is_finite_and_neither_truth_nor_text(value: object) -> None:
    assert len(LampDevice.problems({"sockets": ["a"], "warm_up_s": value})) == 1


@pytest.mark.parametrize(
    ("kind", "driver_name", "former"),
    [
        ("head", "aravis", "held_limit_s"),
        ("thermometer", "ascii-line", "channel_words"),
        ("thermometer", "ascii-line", "open_words"),
    ],
)
def test_a_former_name_is_refused_with_the_present_one(
    kind: str, driver_name: str, former: str
) -> None:
    problems = registry.problems(kind, driver_name, {former: 3})
    assert f"{former} is 3; this setting is now named {FORMER_NAMES[former]}" in problems


def test_a_former_name_of_another_driver_is_only_unknown() -> None:
    (problem, _) = LampDevice.problems({"held_limit_s": 3})
    assert "there is no such setting" in problem
