"""The navigation: folders with their titles in order; pages that are not listed follow by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

FOLDERS: Final[Mapping[str, str]] = {
    "tutorials": "Tutorials",
    "how-to": "How-to",
    "how-to/flight": "In flight",
    "how-to/processing": "Calibration and processing",
    "reference": "Reference",
    "reference/commands": "Commands",
    "reference/flight": "In flight",
    "reference/drivers": "Drivers",
    "reference/results": "Results of tests",
    "reference/python": "Python",
    "reference/python/processing": "processing",
    "reference/python/drivers": "drivers",
    "reference/contributing": "Contributing",
    "explanation": "Explanation",
    "explanation/cameras": "Cameras",
    "explanation/processing": "Processing",
    "explanation/mathematics": "Mathematics",
    "explanation/decisions": "Decisions",
}
"""Titles of the folders, in the order of the navigation."""

FIRST: Final = (
    *("how-to/flight/installation.md", "how-to/flight/finding-devices.md"),
    "how-to/flight/link-budget.md",
    *("how-to/flight/watching.md", "how-to/processing/calibration.md"),
    *("reference/glossary.md", "reference/configuration.md", "reference/rig-file.md"),
    *("reference/formats.md", "explanation/architecture.md"),
    *("explanation/mathematics/coordinates.md", "reference/flight/arming.md"),
    "reference/flight/events.md",
)
"""Pages that stand first in their folder, in this order."""


def navigation(pages: Iterable[str]) -> list[Any]:
    """The navigation as mkdocs.yml would state it.

    Args:
        pages: paths of all pages below docs/.
    """
    listed = sorted(pages, key=_rank)
    return ["index.md", *_folder("", listed)]


def _rank(page: str) -> tuple[bool, int, str]:
    is_index = page.endswith("/index.md")
    return (not is_index, FIRST.index(page) if page in FIRST else len(FIRST), page)


def _folder(folder: str, pages: list[str]) -> list[Any]:
    prefix = f"{folder}/" if folder else ""
    inside = [p for p in pages if p.startswith(prefix) and "/" not in p.removeprefix(prefix)]
    entries: list[Any] = [page for page in inside if page != "index.md"]
    for name, title in FOLDERS.items():
        if name.startswith(prefix) and name != folder and "/" not in name.removeprefix(prefix):
            entries.append({title: _folder(name, pages)})
    return entries
