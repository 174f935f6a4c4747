"""Heads that are connected, each opened once and described; and those that do not answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.cameras.aravis import description as aravis_description
from drivers.cameras.aravis import discovery as aravis_discovery
from drivers.cameras.aravis.discovery import FoundHead
from drivers.cameras.aravis.gvcp import is_ip_address
from drivers.cameras.head_description import HeadDescription
from drivers.cameras.v4l2 import description as v4l2_description
from drivers.cameras.v4l2 import discovery as v4l2_discovery
from drivers.cameras.v4l2.discovery import FoundNode
from drivers.cameras.v4l2.formats import FORMATS
from drivers.contract import DeviceError


@dataclass(frozen=True)
class Discovery:
    """Heads that answered, and one sentence for each that did not.

    `problems` are of heads, `notes` of whole drivers, for example a library that is missing.
    """

    heads: tuple[HeadDescription, ...]
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def discover(
    wanted: Sequence[str] = (),
    *,
    find_genicam: Callable[[], list[FoundHead]] = aravis_discovery.heads,
    find_video: Callable[[], list[FoundNode]] = v4l2_discovery.capture_nodes,
) -> Discovery:
    """Search for heads and describe them.

    Args:
        wanted: addresses, names or paths of the heads to use in order; none takes all. A head
            at an IP address need not answer the discovery.
        find_genicam: heads on networks and USB.
        find_video: capture nodes of the kernel.
    """
    notes: list[str] = []
    genicam: list[FoundHead] = []
    try:
        genicam = find_genicam()
    except DeviceError as error:
        notes.append(str(error))
    nodes = find_video()
    found: dict[str, FoundHead | FoundNode] = {head.address: head for head in genicam}
    for node in nodes:
        if node.problem:
            notes.append(f"{node.path}: {node.problem}; add this user to the group video")
        else:
            found[node.path] = node
    problems: list[str] = []
    if wanted:
        chosen = []
        for place in dict.fromkeys(wanted):
            if place in found:
                chosen.append(found[place])
            elif is_ip_address(place):
                chosen.append(FoundHead(place, "", "", "", "GigEVision"))
            else:
                listed = ", ".join(found) or "none"
                problems.append(f"no head at {place}; found: {listed}. Check its power and cable")
    else:
        chosen = [
            one for one in found.values() if isinstance(one, FoundHead) or _has_usable_format(one)
        ]
        notes += [
            f"{node.path} ({node.card}) has no pixel format of a survey camera; it is left out"
            for node in nodes
            if not node.problem and not _has_usable_format(node)
        ]
    heads = []
    for one in chosen:
        try:
            heads.append(_describe(one))
        except DeviceError as error:
            problems.append(str(error))
    return Discovery(tuple(heads), tuple(problems), tuple(notes))


def _has_usable_format(node: FoundNode) -> bool:
    return any(name in FORMATS for name in node.formats)


def _describe(one: FoundHead | FoundNode) -> HeadDescription:
    if isinstance(one, FoundNode):
        return v4l2_description.describe(one)
    return aravis_description.describe(one)
