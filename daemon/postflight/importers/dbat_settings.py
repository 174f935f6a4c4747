"""Settings of a DBAT script: what is estimated, initial values, filters. What is not honoured is
refused by its name.

Source: the example scripts of DBAT (camera calibration, Rome,
Strasbourg).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from daemon.postflight.adjustment.csv_tables import ProjectError

T = TypeVar("T")

HERE: Final = "$HERE"
"""The folder of the script."""

_INPUTS: Final = frozenset(
    ("c", "ctrl_pts", "check_pts", "images", "image_pts", "cameras", "prior_eo")
)
_PARAMETERS: Final[Mapping[str, tuple[str, ...]]] = {
    "all": ("dx0", "dy0", "df", "k1", "k2", "k3", "p1", "p2", "b1", "b2"),
    "cc": ("df",),
    "pp": ("dx0", "dy0"),
    "px": ("dx0",),
    "py": ("dy0",),
    "aspect": ("b1",),
    "skew": ("b2",),
    "K": ("k1", "k2", "k3"),
    "K1": ("k1",),
    "K2": ("k2",),
    "K3": ("k3",),
    "P": ("p1", "p2"),
    "P1": ("p1",),
    "P2": ("p2",),
}
"""Interior parameters by DBAT's name."""
_STEPS: Final = frozenset(
    ("check_ray_count", "spatial_resection", "forward_intersection", "bundle_adjustment")
)


@dataclass(frozen=True)
class DbatSettings:
    """Free interior parameters, whether the camera's calibrated values begin, and remarks."""

    free: tuple[str, ...]
    io_is_loaded: bool
    notes: tuple[str, ...]


def read_settings(script: str, root: ElementTree.Element) -> DbatSettings:
    """The settings of a script.

    Raises:
        ProjectError: with a sentence for each element that is not honoured.
    """
    problems = [
        f"{script}: input <{child.tag}> is not read; remove it, or adjust in DBAT"
        for child in root.findall("input/*")
        if child.tag not in _INPUTS
    ]
    problems += [
        f"{script}: a filter of {what} is not read; leave rows out of its file"
        for what in ("images", "image_pts", "prior_eo")
        if root.find(f"input/{what}/filter") is not None
    ]
    given = root.find("input")
    base = HERE if given is None else given.get("base_dir", HERE)
    if base not in (HERE, ".") and not base.startswith(f"{HERE}/"):
        problems.append(f"{script}: base_dir {base} is not read; use {HERE} or a folder in it")
    free: list[str] | None = None
    is_loaded, notes = False, []
    for operation in root.findall("operations/operation"):
        children = [child for child in operation if child.tag != "c"]
        name = (operation.text or "").strip().rstrip(">")
        if not children and name and name not in _STEPS:
            problems.append(f"{script}: operation {name} is not read")
        for child in children:
            if child.tag == "set_initial_values":
                is_loaded |= _is_loaded(script, child, problems)
            elif child.tag == "set_bundle_estimate_params":
                free = _free(script, child, problems)
            elif child.tag == "set_datum":
                datum = (child.text or "").strip()
                note = f"set_datum {datum}: imported as a free network (minimum norm)"
                if datum == "depend":
                    note += '; free_datum = "dependent" is the datum of DBAT'
                notes.append(note)
            else:
                problems.append(f"{script}: operation <{child.tag}> is not read")
    if problems:
        raise ProjectError(problems)
    every = [name for name in _PARAMETERS["all"] if name != "b2"]
    return DbatSettings(tuple(every if free is None else free), is_loaded, tuple(notes))


def _is_loaded(script: str, element: ElementTree.Element, problems: list[str]) -> bool:
    """Whether interior orientation begins with the values of the camera file."""
    loaded = False
    for part in element:
        values = [child.text for child in part] or [part.text]
        texts = {(value or "").strip() for value in values}
        if part.tag == "c":
            continue
        if part.tag not in ("io", "eo", "op") or texts - {"default", "loaded"} or len(texts) > 1:
            problems.append(f"{script}: initial values of {part.tag}: {texts} are not read")
        elif part.tag == "io":
            loaded = texts == {"loaded"}
    return loaded


def _free(script: str, element: ElementTree.Element, problems: list[str]) -> list[str]:
    free: dict[str, bool] = dict.fromkeys(_PARAMETERS["all"], False)
    for part in element:
        for child in part:
            value = (child.text or "").strip()
            if part.tag == "io" and child.tag in _PARAMETERS and value in ("true", "false"):
                free |= dict.fromkeys(_PARAMETERS[child.tag], value == "true")
            elif part.tag == "c" or child.tag == "c":
                continue
            elif part.tag == "io" or child.tag != "all" or value not in ("true", "default"):
                problems.append(
                    f"{script}: estimation of {part.tag} {child.tag} {value!r} is not read"
                )
    return [name for name, is_free in free.items() if is_free]


def filtered(
    script: str, filters: Sequence[ElementTree.Element], found: Mapping[str, T]
) -> dict[str, T]:
    """Points that the filters leave: `remove` or `keep` those of a list of ids.

    Raises:
        ProjectError: another filter, or an id that is not there.
    """
    kept = dict(found)
    for one in filters:
        word = (one.text or "").strip()
        ids = [name.strip() for name in (one.get("id") or "").split(",") if name.strip()]
        if word not in ("remove", "keep") or set(one.attrib) != {"id"}:
            raise ProjectError([f"{script}: filter {word!r} by {sorted(one.attrib)} is not read"])
        if absent := [name for name in ids if name not in found]:
            raise ProjectError([f"{script}: filter names points {absent}, which are not there"])
        kept = {name: value for name, value in kept.items() if (name in ids) == (word == "keep")}
    return kept
