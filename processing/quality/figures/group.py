"""Figures that are determined together, the figures of one exposure, and their form in JSON.

A field has the name of its figure in quality.json. A group that is there writes all of its figures:
null where one could not be determined. A group that is not there was not looked for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Final, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

Figure: TypeAlias = float | int | str | None
"""A figure in quality.json."""

Names: TypeAlias = tuple[str, ...]
"""Names of sensors, cones or bands; comma separated in quality.json, null where there are none."""

Group = TypeVar("Group", bound="FigureGroup")
_SEPARATOR: Final = ", "


@dataclass(frozen=True)
class Key:
    """Names in quality.json of a mapping's figures: `dc_k_<cone>` by cone."""

    pattern: str

    def of(self, name: str) -> str:
        """The figure's name for one key of the mapping.

        Args:
            name: the key, such as that of a cone.

        Returns:
            The pattern with the key in the place of `<...>`.
        """
        return re.sub("<.*>", lambda _: name, self.pattern)

    def names_in(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Pick the mapping's figures.

        Args:
            content: figures of quality.json by name.

        Returns:
            Values by key of the mapping.
        """
        form = re.compile(re.sub("<.*>", "(.+)", self.pattern))
        found = {name: form.fullmatch(name) for name in content}
        return {match[1]: content[name] for name, match in found.items() if match is not None}


@dataclass(frozen=True)
class _Field:
    """A field of a group: name, the type of its figures, its meaning, and `Key` of a mapping."""

    name: str
    kind: Any
    meaning: str
    key: Key | None

    @property
    def json_name(self) -> str:
        return self.name if self.key is None else self.key.pattern


@dataclass(frozen=True)
class FigureGroup:
    """Figures that are determined together; None is not determined."""

    def as_json(self) -> dict[str, Figure]:
        """Figures by their documented names.

        Returns:
            All figures of the group, null where one is not determined.
        """
        content: dict[str, Figure] = {}
        for one in _fields(type(self)):
            value = getattr(self, one.name)
            if one.key is not None:
                content |= {one.key.of(name): item for name, item in value.items()}
            else:
                is_names = isinstance(value, tuple)
                content[one.name] = _SEPARATOR.join(value) or None if is_names else value
        return content


@dataclass(frozen=True, init=False)
class QualityFigures:
    """All figures of one exposure, group by group; a later group replaces one of its type."""

    groups: tuple[FigureGroup, ...]

    def __init__(self, *groups: FigureGroup | None) -> None:
        """None is a group that was not looked for."""
        by_type = {type(group): group for group in groups if group is not None}
        object.__setattr__(self, "groups", tuple(by_type.values()))

    def of(self, kind: type[Group]) -> Group:
        """One group of figures.

        Args:
            kind: class of the group.

        Returns:
            The group; where it is not there, one of which nothing is determined.
        """
        return next((group for group in self.groups if isinstance(group, kind)), kind())

    def finite(self) -> QualityFigures:
        """The same without NaN and infinity.

        Returns:
            A copy with None for what is no number.
        """
        return QualityFigures(*(_finite(group) for group in self.groups))

    def as_json(self) -> dict[str, Figure]:
        """Figures by their documented names, as in quality.json.

        Returns:
            Figures of all groups.
        """
        return {name: value for group in self.groups for name, value in group.as_json().items()}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> QualityFigures:
        """Figures as quality.json has them.

        Args:
            content: figures by name.

        Returns:
            Groups of figures; a value of another type is not determined.
        """
        kinds = FigureGroup.__subclasses__()
        named = {one.name for kind in kinds for one in _fields(kind) if one.key is None}
        keyed = {name: value for name, value in content.items() if name not in named}
        return cls(*(_parsed(kind, content, keyed) for kind in kinds))


def documented_figures() -> dict[str, str]:
    """The meaning of every figure.

    Returns:
        Meaning by the name in quality.json.
    """
    kinds = FigureGroup.__subclasses__()
    return {one.json_name: one.meaning for kind in kinds for one in _fields(kind)}


_FIELDS: Final[dict[type[FigureGroup], tuple[_Field, ...]]] = {}


def _fields(kind: type[FigureGroup]) -> tuple[_Field, ...]:
    if kind not in _FIELDS:
        hints = get_type_hints(kind, include_extras=True)
        _FIELDS[kind] = tuple(_field(one.name, hints[one.name]) for one in fields(kind))
    return _FIELDS[kind]


def _field(name: str, hint: Any) -> _Field:
    if get_origin(hint) is not Annotated:
        raise TypeError(f"{name} has no documented meaning")
    kind, meaning, *key = get_args(hint)
    return _Field(name, kind, meaning, key[0] if key else None)


def _finite(group: FigureGroup) -> FigureGroup:
    changed: dict[str, Any] = {}
    for one in _fields(type(group)):
        value = getattr(group, one.name)
        if one.key is not None:
            changed[one.name] = {name: _number(item) for name, item in value.items()}
        elif isinstance(value, float):
            changed[one.name] = _number(value)
    return replace(group, **changed)


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _parsed(
    kind: type[FigureGroup], content: Mapping[str, Any], keyed: Mapping[str, Any]
) -> FigureGroup | None:
    values: dict[str, Any] = {}
    for one in _fields(kind):
        if one.key is not None and (found := one.key.names_in(keyed)):
            item_kind = get_args(one.kind)[1]
            values[one.name] = {name: _typed(item, item_kind) for name, item in found.items()}
        elif one.key is None and one.name in content:
            values[one.name] = _typed(content[one.name], one.kind)
    return kind(**values) if values else None


def _typed(value: Any, kind: Any) -> Any:
    """A value of quality.json as the type of its figure; None, or no names, if it is no such."""
    if kind == Names:
        return tuple(value.split(_SEPARATOR)) if isinstance(value, str) and value else ()
    accepted = get_args(kind)
    if float in accepted and isinstance(value, int) and not isinstance(value, bool):
        return value
    return value if isinstance(value, accepted) and not isinstance(value, bool) else None
