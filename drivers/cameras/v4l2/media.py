"""The graph of a media device: its parts, their links, and the way from a sensor to a video node.

Nothing is configured here; that is in `drivers.cameras.v4l2.pipeline`.

Source: Documentation/userspace-api/media/mediactl of the kernel.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from drivers.cameras.v4l2 import media_uapi
from drivers.cameras.v4l2.control_port import text_of

NODES: Final = Path("/dev")
CHARACTER_DEVICES: Final = Path("/sys/dev/char")
READ_ATTEMPTS: Final = 3
"""The graph may grow between the question for its size and the one for its content."""


@dataclass(frozen=True)
class Entity:
    """A part of a media device; `path` is its device node, empty where it has none."""

    id: int
    name: str
    function: int
    path: str = ""

    @property
    def is_sensor(self) -> bool:
        """Whether it is the sensor of a camera."""
        return self.function == media_uapi.ENT_F_CAM_SENSOR


@dataclass(frozen=True)
class PadLink:
    """A data link from a source pad to a sink pad, both as (entity, pad)."""

    source: tuple[int, int]
    sink: tuple[int, int]
    is_enabled: bool


@dataclass(frozen=True)
class MediaGraph:
    """The parts of a media device by id, and their links; `path` is /dev/media0 or another."""

    path: str
    entities: Mapping[int, Entity]
    links: tuple[PadLink, ...]

    def entity_at(self, path: str) -> Entity | None:
        """The part behind a device node.

        Args:
            path: of the device node.

        Returns:
            The part; None where the graph has none of that node.
        """
        return next((each for each in self.entities.values() if each.path == path), None)

    def route_to(self, entity: Entity, *, enabled_only: bool = True) -> tuple[PadLink, ...]:
        """Find the way from the nearest sensor to a part.

        Args:
            entity: the part, a video node as a rule.
            enabled_only: whether links that are disabled are left out.

        Returns:
            Links, the sensor's first; empty if there is no way.
        """
        waiting: deque[tuple[int, tuple[PadLink, ...]]] = deque([(entity.id, ())])
        seen = {entity.id}
        while waiting:
            at, route = waiting.popleft()
            if self.entities[at].is_sensor:
                return route
            for link in self.links:
                source = link.source[0]
                if link.sink[0] != at or source in seen or source not in self.entities:
                    continue
                if link.is_enabled or not enabled_only:
                    seen.add(source)
                    waiting.append((source, (link, *route)))
        return ()

    def described(self, link: PadLink) -> str:
        """Describe a link.

        Args:
            link: of this graph.

        Returns:
            Names and pads as media-ctl takes them.
        """
        (source, source_pad), (sink, sink_pad) = link.source, link.sink
        names = self.entities[source].name, self.entities[sink].name
        return f'"{names[0]}":{source_pad} -> "{names[1]}":{sink_pad}'


def graph_of(video_path: str) -> MediaGraph | None:
    """The media device that a video node belongs to.

    Args:
        video_path: of the video node.

    Returns:
        Its graph; None where the node belongs to none.

    Raises:
        OSError: a media device may not be opened (EACCES).
    """
    refused: OSError | None = None
    resolved = str(Path(video_path).resolve())
    for path in sorted(NODES.glob("media*")):
        try:
            graph = read_graph(str(path))
        except OSError as error:
            refused = error if error.errno in (errno.EACCES, errno.EPERM) else refused
            continue
        if graph.entity_at(resolved) is not None:
            return graph
    if refused is not None:
        raise refused
    return None


def read_graph(path: str) -> MediaGraph:
    """The graph of a media device.

    Args:
        path: /dev/media0 or another.

    Returns:
        Parts and links as they are now.

    Raises:
        OSError: it cannot be opened, or is no media device.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        for _ in range(READ_ATTEMPTS):
            try:
                return _graph(path, descriptor)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
        raise OSError(errno.EAGAIN, "its parts keep changing")
    finally:
        os.close(descriptor)


def _graph(path: str, descriptor: int) -> MediaGraph:
    topology = media_uapi.MediaTopology()
    fcntl.ioctl(descriptor, media_uapi.MEDIA_IOC_G_TOPOLOGY, topology)
    entities = (media_uapi.MediaEntity * topology.num_entities)()
    interfaces = (media_uapi.MediaInterface * topology.num_interfaces)()
    pads = (media_uapi.MediaPad * topology.num_pads)()
    links = (media_uapi.MediaLink * topology.num_links)()
    topology.ptr_entities = ctypes.addressof(entities)
    topology.ptr_interfaces = ctypes.addressof(interfaces)
    topology.ptr_pads = ctypes.addressof(pads)
    topology.ptr_links = ctypes.addressof(links)
    fcntl.ioctl(descriptor, media_uapi.MEDIA_IOC_G_TOPOLOGY, topology)
    return _assembled(path, entities, interfaces, pads, links)


def _assembled(path: str, entities: Any, interfaces: Any, pads: Any, links: Any) -> MediaGraph:
    node_of_interface = {each.id: _node_of(each.raw[0], each.raw[1]) for each in interfaces}
    node_of_entity: dict[int, str] = {}
    place_of_pad = {pad.id: (int(pad.entity_id), int(pad.index)) for pad in pads}
    found = []
    for link in links:
        kind = link.flags & media_uapi.LNK_FL_LINK_TYPE
        if kind == media_uapi.LNK_FL_INTERFACE_LINK and link.source_id in node_of_interface:
            node_of_entity[int(link.sink_id)] = node_of_interface[link.source_id]
        elif kind == media_uapi.LNK_FL_DATA_LINK and {link.source_id, link.sink_id} <= {
            *place_of_pad
        }:
            is_enabled = bool(link.flags & media_uapi.LNK_FL_ENABLED)
            ends = place_of_pad[link.source_id], place_of_pad[link.sink_id]
            found.append(PadLink(*ends, is_enabled))
    parts = {
        int(each.id): Entity(
            int(each.id),
            text_of(each.name),
            int(each.function),
            node_of_entity.get(int(each.id), ""),
        )
        for each in entities
    }
    return MediaGraph(path, parts, tuple(found))


def _node_of(major: int, minor: int) -> str:
    """The device node of a number; empty where there is none."""
    try:
        lines = (CHARACTER_DEVICES / f"{major}:{minor}/uevent").read_text().splitlines()
    except OSError:
        return ""
    name = next((line[8:] for line in lines if line.startswith("DEVNAME=")), "")
    return str(NODES / name) if name else ""
