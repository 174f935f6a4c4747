"""Settings of a driver, declared in its class: type, allowed values and meaning.

A configuration section is a mapping of plain values. It is checked key by key, and all errors are
reported at once. The use of a setting is in its driver.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Generic, TypeVar, overload

from drivers.contract import DeviceError

T = TypeVar("T")

FORMER_NAMES: Final[Mapping[str, str]] = {
    "channel_words": "channel_labels",
    "held_limit_s": "control_wait_limit_s",
    "open_words": "open_sensor_labels",
}
"""Former name of a setting to its present name; a former name is refused."""


class SettingsError(DeviceError):
    """Invalid settings; `problems` holds one sentence for each error."""

    def __init__(self, name: str, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(f"{name}: {problem}" for problem in problems))


class Setting(Generic[T]):
    """One setting of a driver class; on an instance, the attribute is the configured value.

    The type follows from the default: bool, int, float (an integer is accepted), str, a tuple of
    str, or a dict of names and plain values. `required` settings must be given; their default only
    defines the type. `minimum` and `maximum` are inclusive. For a tuple, they limit its length.

    Example:
        >>> class Lamp(Configured):
        ...     brightness = Setting(50, minimum=0, maximum=100, help="brightness in percent")
        >>> Lamp("nose", {"brightness": 20}).brightness
        20
        >>> Lamp.problems({"brightness": 300})
        ['brightness is 300; at most 100 (brightness in percent)']
    """

    def __init__(
        self,
        default: T,
        *,
        choices: tuple[T, ...] = (),
        minimum: float | None = None,
        maximum: float | None = None,
        required: bool = False,
        help: str,  # noqa: A002 - as argparse and typer name it
    ) -> None:
        self.default: Final = default
        self.choices: Final = choices
        self.minimum: Final = minimum
        self.maximum: Final = maximum
        self.required: Final = required
        self.help: Final = help
        self.name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Setting[T]: ...

    @overload
    def __get__(self, instance: Configured, owner: type) -> T: ...

    def __get__(self, instance: Configured | None, owner: type) -> Setting[T] | T:
        if instance is None:
            return self
        value: T = instance.configured[self.name]
        return value

    @property
    def type_name(self) -> str:
        """The name of the type in documents and error messages."""
        return _TYPES[type(self.default)][0]

    def convert(self, value: object) -> T:
        """The value as this setting's type.

        Args:
            value: as read from the configuration.

        Returns:
            The converted value; an integer for a float setting becomes a float, a list a tuple.

        Raises:
            ValueError: the value is not allowed; the message states what is.
        """
        type_description, convert = _TYPES[type(self.default)]
        try:
            converted: T = convert(value)
        except TypeError as error:
            raise ValueError(f"{type_description} is needed") from error
        if self.choices and converted not in self.choices:
            raise ValueError("one of " + ", ".join(repr(choice) for choice in self.choices))
        if isinstance(converted, tuple):
            size, unit = float(len(converted)), " names"
        elif isinstance(converted, int | float) and not isinstance(converted, bool):
            size, unit = float(converted), ""
        else:
            if self.required and converted == "":
                raise ValueError("a text that is not empty")
            return converted
        if self.minimum is not None and size < self.minimum:
            raise ValueError(f"at least {self.minimum:g}{unit}")
        if self.maximum is not None and size > self.maximum:
            raise ValueError(f"at most {self.maximum:g}{unit}")
        return converted


class Configured:
    """Base of every driver: a name, and the settings that its class declares.

    Raises:
        SettingsError: on creation, with one sentence per error.
    """

    def __init__(self, name: str, settings: Mapping[str, object]) -> None:
        problems = self.problems(settings)
        if problems:
            raise SettingsError(name, problems)
        self._name = name
        self.configured: Mapping[str, Any] = self._values(settings)
        self.given = frozenset(settings)
        """Names of the settings that were configured, not left at their defaults."""

    @property
    def name(self) -> str:
        """Name from the configuration."""
        return self._name

    @classmethod
    def settings(cls) -> tuple[Setting[Any], ...]:
        """The declared settings.

        Returns:
            Those of the base classes first; an overriding declaration keeps the place of the first.
        """
        found: dict[str, Setting[Any]] = {}
        for owner in reversed(cls.__mro__):
            found.update({k: v for k, v in vars(owner).items() if isinstance(v, Setting)})
        return tuple(found.values())

    @classmethod
    def problems(cls, settings: Mapping[str, object]) -> list[str]:
        """The errors in a configuration section.

        Args:
            settings: the section, plain values by key.

        Returns:
            A sentence for each error with the key, the value found and the allowed values; empty if
            there are none.
        """
        declared = {setting.name: setting for setting in cls.settings()}
        problems = []
        for key, value in settings.items():
            if key not in declared:
                problems.append(f"{key} is {value!r}; {_unknown(key, tuple(declared))}")
                continue
            setting = declared[key]
            try:
                setting.convert(value)
            except ValueError as error:
                problems.append(f"{key} is {value!r}; {error} ({setting.help})")
        problems.extend(
            f"{setting.name} is missing; {setting.type_name} is needed ({setting.help})"
            for setting in declared.values()
            if setting.required and setting.name not in settings
        )
        if not problems:
            problems.extend(cls.setting_conflicts(cls._values(settings)))
        return problems

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        """Conflicts between settings that are valid one by one; overridden by drivers.

        Args:
            values: converted values of all settings by name, defaults included.

        Returns:
            A sentence for each conflict; empty if there are none.
        """
        return []

    @classmethod
    def _values(cls, settings: Mapping[str, object]) -> dict[str, Any]:
        return {
            setting.name: setting.convert(settings[setting.name])
            if setting.name in settings
            else setting.default
            for setting in cls.settings()
        }


def _unknown(key: str, known: Sequence[str]) -> str:
    renamed = FORMER_NAMES.get(key)
    if renamed in known:
        return f"this setting is now named {renamed}"
    close = difflib.get_close_matches(key, known, n=1)
    if close:
        return f"there is no such setting, {close[0]} is meant?"
    return "there is no such setting; there are " + ", ".join(known)


def _bool(value: object) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


def _int(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError
    return value


def _float(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError
    return float(value)


def _str(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value


def _table(value: object) -> dict[str, bool | int | float | str]:
    """A table of names and plain values, in its order."""
    if not isinstance(value, Mapping):
        raise TypeError
    found: dict[str, bool | int | float | str] = {}
    for name, item in value.items():
        if not isinstance(name, str) or not name or not isinstance(item, bool | int | float | str):
            raise TypeError
        found[name] = item
    return found


def _names(value: object) -> tuple[str, ...]:
    if not isinstance(value, list | tuple):
        raise TypeError
    if not all(isinstance(item, str) and item for item in value):
        raise TypeError
    return tuple(value)


_TYPES: Final[Mapping[type, tuple[str, Callable[[object], Any]]]] = {
    bool: ("true or false", _bool),
    int: ("a whole number", _int),
    float: ("a finite number", _float),
    str: ("a text", _str),
    tuple: ("a list of names", _names),
    dict: ("a table of names and values", _table),
}
