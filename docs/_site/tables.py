"""Markdown tables, and rows of keys from the JSON schema of a pydantic model."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

UNITS: Final[Mapping[str, str]] = {
    "_bytes_per_s": "byte/s",
    "_um_per_k": "µm/K",
    "_urad_per_k": "µrad/K",
    "_ppm_per_k": "ppm/K",
    "_ppm_per_mm": "ppm/mm",
    "_e_per_dn": "e/DN",
    "_dn": "DN",
    "_mps": "m/s",
    "_bytes": "byte",
    "_urad": "µrad",
    "_rad": "rad",
    "_deg": "°",
    "_ppm": "ppm",
    "_days": "d",
    "_um": "µm",
    "_us": "µs",
    "_ns": "ns",
    "_ms": "ms",
    "_mm": "mm",
    "_px": "px",
    "_db": "dB",
    "_m": "m",
    "_s": "s",
    "_c": "°C",
    "_e": "electrons",
}
"""Unit by the ending of a key, longest endings first."""


UNBOUNDED: Final = 1e12
"""A limit from here on only keeps numbers finite."""


def unit_of(key: str) -> str:
    """The unit that a key's ending states; empty without one."""
    stem = re.sub(r"_(?:min|max)$", "", key)
    return next((unit for ending, unit in UNITS.items() if stem.endswith(ending)), "")


def cell(text: object) -> str:
    """Text as the content of a cell."""
    return re.sub(r"\s+", " ", str(text)).replace("|", "\\|").strip()


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table of Markdown; each row has as many cells as the header."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(cell, line))} |" for line in lines) + "\n"


def sections(schema: Mapping[str, Any]) -> Iterator[tuple[str, str, list[Sequence[object]]]]:
    """Sections of a TOML file by its schema: header, description, and a row for each key.

    Args:
        schema: JSON schema of a pydantic model; a property that is an object, or a list of
            objects, is a section of its own.

    Yields:
        The section as TOML writes it ("" at the top level), its description, its rows.
    """
    definitions = schema.get("$defs", {})
    yield from _sections("", schema, definitions)


def _sections(
    path: str, schema: Mapping[str, Any], definitions: Mapping[str, Any]
) -> Iterator[tuple[str, str, list[Sequence[object]]]]:
    rows: list[Sequence[object]] = []
    inner: list[tuple[str, Mapping[str, Any]]] = []
    required = set(schema.get("required", ()))
    for key, given in schema.get("properties", {}).items():
        below, is_list = _object_of(given, definitions)
        if below is not None:
            name = f"{path}.{key}".lstrip(".")
            inner.append((f"{name}[]" if is_list else name, below))
            continue
        default = "required" if key in required else _default(given)
        rows.append(
            (
                f"`{key}`",
                _type(given, definitions),
                unit_of(key),
                default,
                _range(given),
                given.get("description", ""),
            )
        )
    if rows or not path:
        yield _header(path), str(schema.get("description", "")), rows
    for name, below in inner:
        yield from _sections(name, below, definitions)


def _header(path: str) -> str:
    """A section as TOML writes it; a list of sections has double brackets."""
    is_list = path.endswith("[]")
    plain = path.replace("[]", "")
    return f"[[{plain}]]" if is_list else f"[{plain}]" if plain else ""


def _object_of(
    given: Mapping[str, Any], definitions: Mapping[str, Any]
) -> tuple[Mapping[str, Any] | None, bool]:
    """The schema of a section behind a property, and whether it is a list of sections."""
    if "$ref" in given:
        found = definitions[given["$ref"].rpartition("/")[2]]
        return (found, False) if "properties" in found else (None, False)
    for choice in (*given.get("anyOf", ()), *given.get("allOf", ())):
        found, is_list = _object_of(choice, definitions)
        if found is not None:
            return found, is_list
    if given.get("type") == "array" and isinstance(given.get("items"), dict):
        found, _ = _object_of(given["items"], definitions)
        return found, True
    return None, False


def _type(given: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    if "$ref" in given:
        return _type(definitions[given["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in given:
        named = [_type(one, definitions) for one in given["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(named))
    if "enum" in given or "const" in given:
        return "choice"
    if given.get("type") == "array":
        items = given.get("prefixItems") or [given.get("items", {})]
        length = given.get("maxItems") if "prefixItems" in given else None
        kind = _type(items[0], definitions)
        return f"{length} × {kind}" if length else f"list of {kind}"
    if given.get("type") == "object":
        values = given.get("additionalProperties")
        return f"table of {_type(values, definitions)}" if isinstance(values, dict) else "table"
    if given.get("format") == "path":
        return "path"
    names = {"string": "text", "boolean": "boolean", "integer": "integer", "number": "number"}
    return names.get(str(given.get("type")), "any")


def _default(given: Mapping[str, Any]) -> str:
    value = given.get("default")
    if value is None or value in ("", [], {}):
        return ""
    return f"`{json.dumps(value, ensure_ascii=False)}`"


def _range(given: Mapping[str, Any]) -> str:
    """Limits and choices of a value, in words and signs."""
    for choice in given.get("anyOf", ()):
        found = _range(choice)
        if found:
            return found
    if "enum" in given:
        return ", ".join(f"`{one}`" for one in given["enum"])
    if "const" in given:
        return f"`{given['const']}`"
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    limits = [
        f"{sign} {given[name]:g}"
        for name, sign in signs.items()
        if name in given and abs(given[name]) < UNBOUNDED
    ]
    if "maxItems" in given and "prefixItems" not in given:
        limits.append(f"at most {given['maxItems']}")
    if given.get("minItems") and "prefixItems" not in given:
        limits.append(f"at least {given['minItems']}")
    return ", ".join(limits)
