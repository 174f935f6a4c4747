"""Elements and attributes of DBAT scripts and camera files that are read or known to be harmless.

Everything else is refused by its name: a script that asks for more would be adjusted otherwise than
in DBAT.

Source: the example scripts of DBAT (camera calibration, Rome, Strasbourg).
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

REMARK: Final = "c"
"""DBAT's element for remarks: it may stand anywhere and hold anything."""
VERSION: Final = re.compile(r"1\.0(\.\d+)?")
UNIT: Final = "m"


@dataclass(frozen=True)
class _Element:
    """Attributes and children of an element; None of children: anything may be in it."""

    attributes: frozenset[str] = frozenset()
    children: frozenset[str] | None = frozenset()
    once: frozenset[str] = frozenset()


def _names(*names: str) -> frozenset[str]:
    return frozenset(names)


_CAMERA: Final = _names(
    *("id", "name", "unit", "calibrated", "sensor", "image", "aspect", "focal", "model"),
    *("nK", "nP", "cc", "pp", "skew", "K", "P"),
)
_SECTIONS: Final = _names("meta", "input", "operations", "output")
_PARTS: Final = _names("io", "eo", "op")
_TABLES: Final = ("ctrl_pts", "check_pts", "image_pts", "prior_eo")
_ROWS: Final = _names("file", "filter")

_SCRIPT: Final[Mapping[str, _Element]] = {
    "document": _Element(_names("dbat_script_version"), _SECTIONS, _SECTIONS),
    "document/input": _Element(_names("base_dir"), children=None),
    **{f"document/input/{one}": _Element(children=_ROWS) for one in _TABLES},
    "document/input/images": _Element(_names("image_base_dir"), _ROWS),
    "document/input/cameras": _Element(children=_names("camera", "file")),
    "document/input/cameras/file": _Element(),
    "document/input/cameras/camera": _Element(children=_CAMERA, once=_CAMERA),
    "document/operations": _Element(children=_names("operation")),
    "document/operations/operation": _Element(_names("min_rays"), children=None),
    "document/operations/operation/set_initial_values": _Element(children=_PARTS, once=_PARTS),
    "document/operations/operation/set_bundle_estimate_params": _Element(
        children=_PARTS, once=_PARTS
    ),
    "document/operations/operation/set_datum": _Element(_names("ref_cam", "ref_base")),
}
"""By path from the root. Other children of `input` and of operations, and attributes of tables and
filters, are checked where they are read."""
_CAMERA_FILE: Final[Mapping[str, _Element]] = {
    "document": _Element(_names("dbat_camera_version"), _names("cameras"), _names("cameras")),
    "document/cameras": _Element(children=_names("camera")),
    "document/cameras/camera": _Element(children=_CAMERA, once=_CAMERA),
}
_ANY: Final = (
    *("document/meta", "document/output"),
    *(f"document/input/{one}/{row}" for one in (*_TABLES, "images") for row in sorted(_ROWS)),
)
"""What may hold anything, or is checked where it is read."""
_WITH_CHILDREN: Final = (
    "document/operations/operation/set_initial_values/",
    "document/operations/operation/set_bundle_estimate_params/",
)


def script_findings(script: str, root: ElementTree.Element) -> list[str]:
    """A sentence for each element and attribute of a script that is not read.

    Args:
        script: name of the file, for the sentences.
        root: its root element.
    """
    found = [*_version(script, root, "dbat_script_version")]
    unit = (root.findtext("meta/project_unit") or UNIT).strip()
    if unit != UNIT:
        found.append(
            f"{script}: <project_unit> is {unit!r}; {UNIT} is read: convert the points to metres"
        )
    found += _strange(script, root, "document", _SCRIPT)
    for operation in root.findall("operations/operation"):
        found += _of_operation(script, operation)
    return found


def camera_file_findings(file: str, root: ElementTree.Element) -> list[str]:
    """A sentence for each element and attribute of a camera file that is not read."""
    return [
        *_version(file, root, "dbat_camera_version"),
        *_strange(file, root, "document", _CAMERA_FILE),
    ]


def ignored(root: ElementTree.Element) -> list[str]:
    """What a script holds that does not change the adjustment, for a note."""
    found = []
    if any(child.tag != REMARK for child in root.findall("output/*")):
        found.append("<output> (plots and files)")
    if any(one.get("image_base_dir") for one in root.findall("input/images")):
        found.append("image_base_dir (no image is opened)")
    return found


def _version(file: str, root: ElementTree.Element, key: str) -> Iterator[str]:
    version = root.get(key)
    if version is not None and VERSION.fullmatch(version.strip()) is None:
        yield f"{file}: {key} is {version!r}; 1.0 is read: save the file with that version"


def _strange(
    file: str, element: ElementTree.Element, path: str, known: Mapping[str, _Element]
) -> Iterator[str]:
    if path in _ANY:
        return
    allowed = known.get(path)
    if allowed is None:
        # A value, or an element whose names are checked where it is read.
        if element.attrib:
            yield _sentence(file, f"attribute {', '.join(element.attrib)} of <{element.tag}>")
        if path.startswith(_WITH_CHILDREN):
            for child in element:
                if child.tag != REMARK:
                    yield from _strange(file, child, f"{path}/{child.tag}", known)
        return
    if strange := [name for name in element.attrib if name not in allowed.attributes]:
        yield _sentence(file, f"attribute {', '.join(strange)} of <{element.tag}>")
    counts = Counter(child.tag for child in element)
    for tag in sorted(allowed.once):
        if counts[tag] > 1:
            yield f"{file}: <{tag}> is {counts[tag]} times in <{element.tag}>; keep one of them"
    for child in element:
        if child.tag == REMARK:
            continue
        if allowed.children is not None and child.tag not in allowed.children:
            yield _sentence(file, f"<{child.tag}> in <{element.tag}>")
        else:
            yield from _strange(file, child, f"{path}/{child.tag}", known)


def _of_operation(script: str, operation: ElementTree.Element) -> Iterator[str]:
    """Attributes belong to one operation each, and text does not stand next to elements."""
    step = (operation.text or "").strip().rstrip(">")
    min_rays = operation.get("min_rays")
    if min_rays is not None and step != "check_ray_count":
        yield _sentence(script, f"attribute min_rays of operation {step or '<...>'}")
    elif min_rays is not None and min_rays.strip() != "2":
        yield (
            f"{script}: min_rays is {min_rays!r}; 2 is read: leave points of fewer rays out of the "
            "files"
        )
    texts = [step, *(child.tail or "" for child in operation)]
    if any(child.tag != REMARK for child in operation) and any(text.strip() for text in texts):
        yield _sentence(script, f"text {' '.join(texts).strip()!r} next to elements of <operation>")


def _sentence(file: str, what: str) -> str:
    return f"{file}: {what} is not read; remove it, or adjust in DBAT"
