"""Features of an opened GenICam head by name: what exists, what may be written, and its value.

Every call goes through `Features`, which turns the errors and assertions of Aravis into one
exception with the reason.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

from drivers import DriverError
from drivers.cameras.aravis.library import aravis, aravis_error, message_of
from drivers.cameras.aravis.presets import FeatureValue

RELATIVE_TOLERANCE: Final = 1e-3
"""Between a number that was written and the number read back; heads round to their steps."""
UNITS_US: Final[Mapping[str, float]] = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1e6),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e3),
    **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), 1.0),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-3),
}
"""Units of durations in lower case, in microseconds."""
DURATION: Final = re.compile(r"[\[(]?(?P<count>\d+(?:\.\d+)?)?\s*(?P<unit>[a-z]+)[\])]?")
CHAIN_MAX: Final = 50
"""Nodes between a feature and its register; a longer chain refers to itself."""


class FeatureError(DriverError):
    """A feature that does not exist or does not accept a value; the message is the reason."""


class Features:
    """The features of one opened device. Not thread-safe.

    Args:
        device: the device of Aravis.
        endless: features that refer to themselves; they are not available, and never evaluated.
    """

    def __init__(self, device: Any, endless: Collection[str] = ()) -> None:
        self._device = device
        self.endless = endless
        self._library = aravis()
        self._failed = aravis_error()
        self._chains: dict[str, tuple[str, ...]] = {}

    def kind(self, name: str) -> str | None:
        """The type of a feature's value.

        Args:
            name: GenICam name.

        Returns:
            `boolean`, `integer`, `float`, `enumeration`, `string` or `command`; None if the head's
            description has no feature of this name, or only a category.
        """
        node = None if name in self.endless else self._device.get_feature(name)
        library = self._library
        if node is None or isinstance(node, library.GcCategory):
            return None
        for found, type_ in (
            ("command", library.GcCommand),
            ("boolean", library.GcBoolean),
            ("enumeration", library.GcEnumeration),
            ("float", library.GcFloat),
            ("integer", library.GcInteger),
            ("string", library.GcString),
        ):
            if isinstance(node, type_):
                return found
        return None

    def is_implemented(self, name: str) -> bool:
        """Whether this head has the feature; a family of heads shares one description.

        Args:
            name: GenICam name.

        Returns:
            False also if the head does not answer.
        """
        # Quirk: Aravis reports a feature as available that the head does not implement, and looks
        # at the feature alone, not at the node that holds its value. Both are checked here.
        # Upstream: no report known (2026-11-24); arv_gc_feature_node_is_available.
        chain = self._chain(name)
        try:
            return bool(chain) and all(node.is_implemented() for node in chain)
        except self._failed:
            return False

    def is_available(self, name: str) -> bool:
        """Whether the head has the feature and offers it in its present state.

        Args:
            name: GenICam name.

        Returns:
            False also if the head does not answer.
        """
        if not self.is_implemented(name):
            return False
        try:
            return all(node.is_available() for node in self._chain(name))
        except self._failed:
            return False

    def is_locked(self, name: str) -> bool:
        """Whether another setting of the head locks the feature.

        Args:
            name: GenICam name.

        Returns:
            False also if the head does not answer.
        """
        try:
            return any(node.is_locked() for node in self._chain(name))
        except self._failed:
            return False

    def is_writable(self, name: str) -> bool:
        """Whether the feature is available, not locked and not read-only.

        Args:
            name: GenICam name.

        Returns:
            False also if the head does not answer.
        """
        # Quirk: Aravis writes features that the head's description locks. The lock is checked here.
        # Upstream: AravisProject/aravis#826.
        if not self.is_available(name) or self.is_locked(name):
            return False
        read_only = self._library.GcAccessMode.RO
        try:
            return all(node.get_actual_access_mode() != read_only for node in self._chain(name))
        except self._failed:
            return False

    def unit_us(self, name: str) -> float | None:
        """The unit of a duration.

        Args:
            name: GenICam name.

        Returns:
            The unit that the description states, us, such as 10 for `10 us`; 1 if it states none,
            None if it states one that is no time, such as rows.
        """
        # Quirk: the standard has microseconds; some heads state seconds or milliseconds.
        # Upstream: manual: GenICam description of Hamamatsu C16240-20UP, ExposureTime.
        # Whatever stands for the letter mu, in whatever encoding, is no ASCII.
        stated = re.sub(r"[^\x00-\x7f]+", "u", self.unit(name)).lower()
        if not stated:
            return 1.0
        found = DURATION.fullmatch(stated)
        unit_us = UNITS_US.get(found["unit"]) if found else None
        return None if found is None or unit_us is None else float(found["count"] or 1) * unit_us

    def description(self, name: str) -> str:
        """The text of the head's description of a feature.

        Args:
            name: GenICam name.

        Returns:
            Its tool tip, description and displayed name; empty if it has none.
        """
        node = None if name in self.endless else self._device.get_feature(name)
        texts = ("get_tooltip", "get_description", "get_display_name")
        return "\n".join(filter(None, (getattr(node, text, str)() for text in texts)))

    def unit(self, name: str) -> str:
        """The unit that the head's description states.

        Args:
            name: GenICam name.

        Returns:
            Such as `us` or `dB`; empty if it states none.
        """
        node = None if name in self.endless else self._device.get_feature(name)
        return str(getattr(node, "get_unit", str)() or "").strip()

    def _chain(self, name: str) -> list[Any]:
        """A feature and the nodes that hold its value; empty if there is no such feature."""
        if name not in self._chains:
            chain: list[str] = []
            following = "" if self.kind(name) is None else name
            while following and len(chain) < CHAIN_MAX:
                chain.append(following)
                following = self._value_node(following)
            # Names, since a node that outlives its device is invalid.
            self._chains[name] = tuple(chain)
        return [self._device.get_feature(link) for link in self._chains[name]]

    def _value_node(self, name: str) -> str:
        """The node that a node takes its value from; empty for a register or constant."""
        library = self._library
        child = self._device.get_feature(name).get_first_child()
        while child is not None:
            if isinstance(child, library.GcPropertyNode) and child.get_node_name() == "pValue":
                found = child.get_linked_node()
                is_feature = isinstance(found, library.GcFeatureNode)
                return str(found.get_name()) if is_feature else ""
            child = child.get_next_sibling()
        return ""

    def entries(self, name: str) -> list[str]:
        """The entries that an enumeration offers in the head's present state.

        Args:
            name: GenICam name.

        Returns:
            Names of the entries; empty if the feature is no enumeration or is not available.
        """
        if self.kind(name) != "enumeration":
            return []
        try:
            found = self._device.dup_available_enumeration_feature_values_as_strings(name)
        except self._failed:
            return []
        return [str(entry) for entry in found or ()]

    def bounds(self, name: str) -> tuple[float, float]:
        """Lowest and highest value of a number.

        Args:
            name: GenICam name.

        Returns:
            Both bounds, inclusive, in the feature's unit; infinite if the head states none.
        """
        try:
            if self.kind(name) == "integer":
                low, high = self._device.get_integer_feature_bounds(name)
            else:
                low, high = self._device.get_float_feature_bounds(name)
        except self._failed:
            return -math.inf, math.inf
        if not low <= high or not (math.isfinite(low) or math.isfinite(high)):
            return -math.inf, math.inf
        return float(low), float(high)

    def increment(self, name: str) -> int:
        """Step of an integer.

        Args:
            name: GenICam name.

        Returns:
            The step; 1 if the head states none.
        """
        try:
            return max(1, int(self._device.get_integer_feature_increment(name)))
        except self._failed:
            return 1

    def get(self, name: str) -> FeatureValue:
        """The value of a feature.

        Args:
            name: GenICam name.

        Returns:
            Its value in the type of the feature.

        Raises:
            FeatureError: the head has no such feature, or does not return it.
        """
        device = self._device
        try:
            match self.kind(name):
                case "boolean":
                    return bool(device.get_boolean_feature_value(name))
                case "integer":
                    return int(device.get_integer_feature_value(name))
                case "float":
                    return float(device.get_float_feature_value(name))
                case "enumeration" | "string":
                    value = device.get_string_feature_value(name)
                    if value is None:
                        raise FeatureError(f"{name} has no valid value")
                    return str(value)
                case "command":
                    raise FeatureError(f"{name} is a command and has no value")
        except self._failed as error:
            raise FeatureError(f"{name} cannot be read: {message_of(error)}") from None
        except UnicodeDecodeError:
            # Quirk: PyGObject raises UnicodeDecodeError for a text that is not UTF-8.
            # Upstream: no report known (2026-11-23).
            raise FeatureError(f"{name} is no text in UTF-8") from None
        raise FeatureError(f"the head has no feature {name}")

    def number(self, name: str) -> float | None:
        """The value of a number.

        Args:
            name: GenICam name.

        Returns:
            The value; None if the head does not offer it or it is not finite.
        """
        if not self.is_available(name):
            return None
        try:
            value = self.get(name)
        except FeatureError:
            return None
        if isinstance(value, str | bool) or not math.isfinite(value):
            return None
        return float(value)

    def text(self, name: str) -> str:
        """The value of an enumeration or text.

        Args:
            name: GenICam name.

        Returns:
            The value; empty if the head does not offer it.
        """
        if not self.is_available(name):
            return ""
        try:
            return str(self.get(name))
        except FeatureError:
            return ""

    def set(
        self,
        name: str,
        value: FeatureValue,
        *,
        tolerance: float = RELATIVE_TOLERANCE,
        within: float = 0.0,
    ) -> FeatureValue:
        """Write a feature and read it back.

        A feature that already has the value is not written.

        Args:
            name: GenICam name.
            value: in the type of the feature; any value executes a command.
            tolerance: relative, between a number and the one that the head then holds.
            within: the same, absolute, in the unit of the feature.

        Returns:
            The value the head holds afterwards; a number may be rounded to the head's step.

        Raises:
            FeatureError: the head refuses the value or does not keep it.
        """
        kind = self.kind(name)
        if kind == "command":
            self.execute(name)
            return True
        converted = _converted(name, kind, value)
        if not self.is_implemented(name):
            raise FeatureError(f"the head has no feature {name}")
        if not self.is_available(name):
            raise FeatureError(f"{name} is not available in the head's present state")
        if self._is_held(name, converted):
            return self.get(name)
        if not self.is_writable(name):
            reason = "locked by another setting" if self.is_locked(name) else "read-only"
            raise FeatureError(f"{name} is {self._shown(name)} and {reason}")
        if kind == "enumeration" and converted not in self.entries(name):
            offered = ", ".join(self.entries(name)) or "no entry"
            raise FeatureError(f"{name} has no entry {converted}; the head has {offered}")
        try:
            self._write(name, kind, converted)
        except self._failed as error:
            raise FeatureError(f"{name} = {converted} is refused: {message_of(error)}") from None
        found = self.get(name)
        if not _is_close(found, converted, tolerance, within):
            raise FeatureError(f"{name} was set to {converted}, and the head holds {found}")
        return found

    def write_only(self, name: str, value: int) -> None:
        """Write an integer that the head does not return.

        Args:
            name: GenICam name.
            value: the integer.

        Raises:
            FeatureError: the head has no such feature or refuses the value.
        """
        if self.kind(name) != "integer":
            raise FeatureError(f"the head has no feature {name}")
        try:
            self._device.set_integer_feature_value(name, value)
        except self._failed as error:
            raise FeatureError(f"{name} = {value} is refused: {message_of(error)}") from None

    def execute(self, name: str) -> None:
        """Execute a command.

        Args:
            name: GenICam name.

        Raises:
            FeatureError: the head has no such command or refuses it.
        """
        if self.kind(name) != "command":
            raise FeatureError(f"the head has no command {name}")
        try:
            self._device.execute_command(name)
        except self._failed as error:
            raise FeatureError(f"{name} is refused: {message_of(error)}") from None

    def first_available(self, names: Sequence[str]) -> str | None:
        """The first feature that the head offers.

        Args:
            names: GenICam names, in the order of preference.

        Returns:
            One of them; None if the head offers none.
        """
        return next((name for name in names if self.is_available(name)), None)

    def first_entry(self, name: str, wanted: Sequence[str]) -> str | None:
        """The first entry that an enumeration offers.

        Args:
            name: GenICam name.
            wanted: entries, in the order of preference.

        Returns:
            One of them; None if the enumeration offers none.
        """
        offered = self.entries(name)
        return next((entry for entry in wanted if entry in offered), None)

    def _is_held(self, name: str, value: FeatureValue) -> bool:
        try:
            return self.get(name) == value
        except FeatureError:
            return False

    def _shown(self, name: str) -> str:
        try:
            return str(self.get(name))
        except FeatureError:
            return "unreadable"

    def _write(self, name: str, kind: str | None, value: FeatureValue) -> None:
        device = self._device
        if kind == "boolean":
            device.set_boolean_feature_value(name, value)
        elif kind == "integer":
            device.set_integer_feature_value(name, value)
        elif kind == "float":
            device.set_float_feature_value(name, value)
        else:
            device.set_string_feature_value(name, value)


def _converted(name: str, kind: str | None, value: FeatureValue) -> FeatureValue:
    """The value in the type of the feature. FeatureError: it is of another type."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind == "boolean" and isinstance(value, bool):
        return value
    if kind == "integer" and is_number and float(value) == int(value):
        return int(value)
    if kind == "float" and is_number:
        return float(value)
    if kind in ("enumeration", "string") and isinstance(value, str):
        return value
    if kind is None:
        raise FeatureError(f"the head has no feature {name}")
    needed = {"boolean": "true or false", "integer": "a whole number", "float": "a number"}
    raise FeatureError(f"{name} = {value!r}; {needed.get(kind, 'a text')} is needed")


def _is_close(found: FeatureValue, wanted: FeatureValue, tolerance: float, within: float) -> bool:
    if isinstance(found, str) or isinstance(wanted, str | bool):
        return found == wanted
    return math.isclose(found, wanted, rel_tol=tolerance, abs_tol=max(within, 1e-9))
