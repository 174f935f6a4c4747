"""Settings of a DBAT script: what is estimated, initial values, filters. What is not honoured is
refused by its name.

Source: the example scripts of DBAT (camera calibration, Rome,
Strasbourg).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from daemon.postflight.adjustment.csv_tables import ProjectError
from daemon.postflight.importers.dbat_elements import REMARK, ignored, script_findings

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
_PARTS: Final = ("io", "eo", "op")
"""Interior and exterior orientation, object points; others are refused by `script_findings`."""
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
    problems = script_findings(script, root)
    problems += [
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
    # DBAT begins with no parameter estimated, and each operation changes those that it names.
    free: dict[str, bool] = dict.fromkeys(_PARAMETERS["all"], False)
    is_stated, is_loaded, notes = False, False, []
    has_prior = root.find("input/prior_eo") is not None
    for operation in root.findall("operations/operation"):
        children = [child for child in operation if child.tag != REMARK]
        name = (operation.text or "").strip().rstrip(">")
        if not children and name and name not in _STEPS:
            problems.append(f"{script}: operation {name} is not read")
        for child in children:
            if child.tag == "set_initial_values":
                is_loaded |= _is_loaded(script, child, problems, has_prior=has_prior)
            elif child.tag == "set_bundle_estimate_params":
                is_stated = True
                _set_free(script, child, free, problems)
            elif child.tag == "set_datum":
                datum = (child.text or "").strip()
                note = f"set_datum {datum}: imported as a free network (minimum norm)"
                if datum == "depend":
                    note += '; free_datum = "dependent" is the datum of DBAT'
                notes.append(note)
            else:
                problems.append(f"{script}: operation <{child.tag}> is not read")
    if not is_stated:
        problems.append(
            f"{script}: no <set_bundle_estimate_params>, so that it does not state which "
            "parameters are estimated; add it, with <all> of io, eo and op"
        )
    if problems:
        raise ProjectError(problems)
    if harmless := ignored(root):
        notes.append(f"ignored: {', '.join(harmless)}")
    estimated = tuple(name for name, is_free in free.items() if is_free)
    return DbatSettings(estimated, is_loaded, tuple(notes))


def _values(script: str, part: ElementTree.Element, problems: list[str]) -> dict[str, str]:
    """Values by the names in a part; text in the part itself is that of all."""
    counts = Counter(child.tag for child in part if child.tag != REMARK)
    problems += [
        f"{script}: <{name}> is {count} times in <{part.tag}>; keep one of them"
        for name, count in counts.items()
        if count > 1
    ]
    named = {child.tag: (child.text or "").strip() for child in part if child.tag != REMARK}
    return named or {"all": (part.text or "").strip()}


def _is_loaded(
    script: str, element: ElementTree.Element, problems: list[str], *, has_prior: bool
) -> bool:
    """Whether interior orientation begins with the values of the camera file."""
    loaded = False
    for part in element:
        if part.tag not in _PARTS:
            continue
        values = _values(script, part, problems)
        if not _is_all(values, ("default", "loaded")):
            problems.append(f"{script}: initial values of {part.tag}: {values} are not read")
        elif part.tag == "io":
            loaded = values["all"] == "loaded"
        elif part.tag == "eo" and (values["all"] == "loaded") != has_prior:
            problems.append(
                f"{script}: initial values of eo are {values['all']!r}, and <prior_eo> is "
                + ("there, which is used: write loaded" if has_prior else "not there: add it")
            )
    return loaded


def _is_all(values: Mapping[str, str], allowed: Sequence[str]) -> bool:
    return set(values) == {"all"} and values["all"] in allowed


def _set_free(
    script: str, element: ElementTree.Element, free: dict[str, bool], problems: list[str]
) -> None:
    """Change which interior parameters are free, in the order of the script."""
    for part in element:
        if part.tag not in _PARTS:
            continue
        values = _values(script, part, problems)
        if part.tag != "io":
            if not _is_all(values, ("true", "default")):
                listed = ", ".join(f"{name} {value!r}" for name, value in values.items())
                problems.append(f"{script}: estimation of {part.tag} {listed} is not read")
            continue
        for name, value in values.items():
            if name in _PARAMETERS and value in ("true", "false"):
                free |= dict.fromkeys(_PARAMETERS[name], value == "true")
            else:
                problems.append(f"{script}: estimation of io {name} {value!r} is not read")


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
