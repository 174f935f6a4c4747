"""Which video capture nodes there are, and how the one that a configuration means is found."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.cameras.v4l2.formats import format_of_code
from drivers.cameras.v4l2.media import graph_of
from drivers.cameras.v4l2.node import VideoNode
from drivers.cameras.v4l2.pipeline import route_of
from drivers.cameras.v4l2.uapi import fourcc_name
from drivers.contract import DeviceError

NODES: Final = Path("/dev")
SYSFS: Final = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class FoundNode:
    """A capture node.

    `problem` is the reason why it cannot be queried, `refusal` why it cannot be a head.
    """

    path: str
    card: str = ""
    driver: str = ""
    bus: str = ""
    serial: str = ""
    formats: tuple[str, ...] = ()
    problem: str = ""
    refusal: str = ""


def capture_nodes() -> list[FoundNode]:
    """Every capture node of this host; nodes of other kinds are omitted.

    Returns:
        The nodes, sorted by number.
    """
    found = []
    for path in sorted(NODES.glob("video*"), key=lambda p: (len(p.name), p.name)):
        try:
            node = VideoNode(str(path))
        except OSError as error:
            if error.errno not in (errno.ENODEV, errno.ENOTTY, errno.ENXIO):
                found.append(FoundNode(str(path), problem=error.strerror or str(error)))
            continue
        try:
            formats = tuple(_name(code) for code in node.formats())
            refusal = _refusal(node)
        except OSError:
            formats, refusal = (), ""
        finally:
            node.close()
        found.append(
            FoundNode(
                str(path),
                node.card,
                node.driver,
                node.bus,
                serial_number(str(path)),
                formats,
                refusal=refusal,
            )
        )
    return found


def path_of(device: str) -> str | None:
    """The node of a configured device.

    Args:
        device: a path, or a bus as printed by v4l2-ctl.

    Returns:
        Path of the node; None if there is none.
    """
    if device.startswith("/"):
        return device if Path(device).exists() else None
    return next((node.path for node in capture_nodes() if node.bus == device), None)


def serial_number(path: str) -> str:
    """The serial number of the USB device behind a node.

    Args:
        path: path of the node.

    Returns:
        The serial number; empty if it has none.
    """
    try:
        place = (SYSFS / Path(path).resolve().name / "device").resolve(strict=True)
    except OSError:
        return ""
    for folder in (place, *list(place.parents)[:2]):
        try:
            return (folder / "serial").read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError):
            continue
    return ""


def _refusal(node: VideoNode) -> str:
    """Why no sensor can be reached through a node of a media pipeline; empty where one can."""
    if not node.is_media_centric:
        return ""
    graph = graph_of(node.path)
    entity = None if graph is None else graph.entity_at(node.path)
    if graph is None or entity is None:
        return ""
    try:
        route_of(graph, entity)
    except DeviceError as error:
        return str(error)
    return ""


def _name(code: int) -> str:
    ours = format_of_code(code)
    return ours.name if ours else fourcc_name(code)
