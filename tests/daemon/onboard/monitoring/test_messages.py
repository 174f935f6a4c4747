"""The catalogs of the page: complete, with the same placeholders, and all of them used."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from daemon.onboard.flight.event_table import TABLE, entry_of
from daemon.onboard.flight.fault_latches import FaultLatches
from daemon.onboard.flight.flag_table import FLAG_TABLE
from daemon.onboard.monitoring.web.page_files import PAGE

LANGUAGES = ("en", "de", "fr", "es", "zh")
CATALOGS = ("page", "map", "alarm", "landing", "server")
PLURALS = (".one", ".other")
OWN_ALARMS = ("alarm.page.",)
"""Alarms that the page raises; their text is in the catalog only."""


def catalog(language: str, name: str) -> dict[str, str]:
    content = json.loads((PAGE / "messages" / language / f"{name}.json").read_text("utf-8"))
    assert isinstance(content, dict)
    return content


def all_codes() -> dict[str, str]:
    return {code: text for name in CATALOGS for code, text in catalog("en", name).items()}


def sources() -> dict[Path, str]:
    files = [*PAGE.glob("*.js"), *PAGE.glob("*.html")]
    return {path: path.read_text("utf-8") for path in files}


@pytest.mark.parametrize("name", CATALOGS)
@pytest.mark.parametrize("language", LANGUAGES[1:])
def test_a_language_has_every_string_with_the_same_placeholders(language: str, name: str) -> None:
    english, other = catalog("en", name), catalog(language, name)
    assert list(other) == list(english)
    for code, text in other.items():
        assert text.strip(), code
        placeholders = set(re.findall(r"\{\w+\}", text))
        assert placeholders == set(re.findall(r"\{\w+\}", english[code])), code


def test_the_page_uses_no_string_that_is_not_in_the_catalogs() -> None:
    codes = all_codes()
    known = set(codes) | {code.removesuffix(end) for code in codes for end in PLURALS}
    for path, text in sources().items():
        used = set(re.findall(r'data-t(?:-label|-title)?="([^"]+)"', text))
        used |= set(re.findall(r'\bt\("([^"$]+)"', text))
        assert used <= known, (path.name, used - known)


def test_no_string_of_the_catalogs_is_unused() -> None:
    text = "\n".join(sources().values())
    # A code that is put together: everything before its first variable part is named.
    prefixes = tuple(re.findall(r"[\"`]([a-z_]+\.(?:[a-z_]+\.)*)\$\{", text))
    unused = []
    for code in all_codes():
        name = next((code.removesuffix(end) for end in PLURALS if code.endswith(end)), code)
        if f'"{name}"' not in text and not name.startswith(prefixes):
            unused.append(code)
    assert unused == []


def test_every_alarm_and_flag_of_the_catalogs_is_known_to_explain() -> None:
    flags = {flag.name for flag in FLAG_TABLE}
    english = catalog("en", "alarm")
    for code, text in english.items():
        if code.startswith(OWN_ALARMS):
            continue
        kind, _, name = code.partition(".")
        if kind == "flag":
            assert name in flags
        elif name.endswith(".action"):
            entry = entry_of(name.removesuffix(".action"))
            assert entry is not None
            assert text == entry.action, code
        elif name.endswith(".cause"):
            entry = entry_of(name.removesuffix(".cause"))
            assert entry is not None
            assert text == entry.cause, code
        else:
            assert entry_of(name) is not None, code
    assert {f"flag.{name}" for name in flags} <= set(english)


def test_every_event_that_latches_a_fault_has_a_name_in_every_language() -> None:
    english = catalog("en", "alarm")
    latched = {entry.name for entry in TABLE if entry.severity != "info" and latches(entry.name)}
    assert {"deviation", "decisions", "disk", "device/lost", "page-link"} <= latched
    for name in latched:
        assert f"alarm.{name}" in english, name
        assert f"alarm.{name}.cause" in english, name
        assert f"alarm.{name}.action" in english, name


def latches(name: str) -> bool:
    """Whether an event of the table, sent as a fault, raises one under its name."""
    kind, _, of_device = name.partition("/")
    event = {"event": kind, "name": of_device, "device": "one", "sentence": "It.", "fault": True}
    faults = FaultLatches()
    faults.apply(event | {"disk": "a", "item": "one", "number": 1, "cause": "it"})
    return any(one["code"] == name for one in faults.listed())
