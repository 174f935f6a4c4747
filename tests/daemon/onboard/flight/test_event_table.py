"""Every event that the code emits is in the table, with a cause and a cure, and in the docs."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from daemon.onboard.flight.event_table import TABLE, Severity, as_markdown, entry_of

ROOT = Path(__file__).parents[4]
EMITTERS = {
    "_event": "",
    "_emit": "",
    "_emit_event": "",
    "emit": "device/",
    "emit_throttled": "device/",
    "_alarm": "device/",
}
GENERIC = "device"
"""The event that carries those of devices, each by its name."""


def emitted() -> Iterator[tuple[str, str]]:
    """Names of events in the sources of service and drivers, and where they are."""
    for folder in ("daemon", "drivers"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                name = _event_of(node, is_driver=folder == "drivers")
                if name is not None:
                    yield name, str(path)


def _event_of(node: ast.AST, *, is_driver: bool) -> str | None:
    if isinstance(node, ast.Dict):
        for key, value in zip(node.keys, node.values, strict=True):
            if isinstance(key, ast.Constant) and key.value == "event":
                return str(value.value) if isinstance(value, ast.Constant) else None
    if is_driver and isinstance(node, ast.Yield) and isinstance(node.value, ast.Tuple):
        # An event and its sentence, which the caller emits.
        first = node.value.elts[0]
        is_event = isinstance(first, ast.Constant) and str(first.value).islower()
        return f"device/{first.value!s}" if is_event else None
    if not isinstance(node, ast.Call) or not node.args:
        return None
    called = node.func.attr if isinstance(node.func, ast.Attribute) else ""
    called = node.func.id if isinstance(node.func, ast.Name) else called
    first = node.args[0]
    if called == "ClockEvent" and isinstance(first, ast.Constant):
        return f"device/{first.value!s}"
    if called == "DeviceEvent" and len(node.args) > 1 and isinstance(node.args[1], ast.Constant):
        return f"device/{node.args[1].value!s}"
    if called not in EMITTERS or not isinstance(first, ast.Constant):
        return None
    if called in ("emit", "emit_throttled") and not is_driver:
        return None
    return f"{EMITTERS[called]}{first.value!s}"


def test_every_event_in_the_sources_is_in_the_table() -> None:
    found = dict(emitted())
    assert len(found) > 35
    found.pop(GENERIC)
    unknown = {name: where for name, where in found.items() if entry_of(name) is None}
    assert unknown == {}


def test_every_event_in_the_table_is_emitted() -> None:
    found = dict(emitted()) | {"device/absent": "", "phase": ""}
    never = {e.name for e in TABLE if e.name not in found and not e.name.startswith("arming-")}
    assert never == set()


def test_every_entry_has_cause_and_action_in_complete_sentences() -> None:
    assert len({entry.name for entry in TABLE}) == len(TABLE)
    for entry in TABLE:
        assert entry.severity in get_args(Severity), entry
        assert entry.cause.endswith("."), entry
        assert entry.action.endswith("."), entry
        assert entry.severity == "info" or entry.action != "None.", entry


def test_the_page_of_the_docs_is_current() -> None:
    page = (ROOT / "docs/reference/flight/events.md").read_text("utf-8")
    command = "syntopic explain --markdown > docs/reference/flight/events.md"
    assert page == as_markdown(), f"run: {command}"
