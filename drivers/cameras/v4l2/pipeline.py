"""The media pipeline from a sensor to its video node: formats of all parts on the way.

The kernel's driver of such a video node leaves the sensor and the parts in between to whoever opens
it: every pad gets the same format, or the stream does not start.

Source: Documentation/userspace-api/media/v4l/dev-subdev.rst; media/drivers/camera-sensor.rst.
"""

from __future__ import annotations

import contextlib
import errno
from dataclasses import dataclass

from drivers.cameras.v4l2 import media_uapi
from drivers.cameras.v4l2.control_port import ControlPort
from drivers.cameras.v4l2.media import Entity, MediaGraph, PadLink
from drivers.contract import DeviceError


@dataclass(frozen=True)
class PadFormat:
    """What a pad sends or takes; `code` is a media bus code."""

    width_px: int
    height_px: int
    code: int

    def __str__(self) -> str:
        return f"{self.width_px} x {self.height_px} {media_uapi.bus_name(self.code)}"


class SubDevice(ControlPort):
    """An opened sub-device: its pads and its controls.

    Raises:
        OSError: it cannot be opened.
    """

    def codes(self, pad: int) -> list[int]:
        """List what a pad can send or take.

        Args:
            pad: number of the pad.

        Returns:
            Media bus codes; empty where the part does not list them.
        """
        found: list[int] = []
        for index in range(256):
            one = media_uapi.BusCodeDescription(
                pad=pad, index=index, which=media_uapi.SUBDEV_FORMAT_ACTIVE
            )
            try:
                self._call(media_uapi.VIDIOC_SUBDEV_ENUM_MBUS_CODE, one)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):
                    break
                raise
            found.append(int(one.code))
        return found

    def pad_format(self, pad: int) -> PadFormat:
        """The format of a pad as it stands.

        Args:
            pad: number of the pad.

        Returns:
            Size and media bus code.
        """
        return _pad_format(self._call(media_uapi.VIDIOC_SUBDEV_G_FMT, _format(pad)))

    def set_pad_format(self, pad: int, wanted: PadFormat) -> PadFormat:
        """Ask for a format of a pad.

        Args:
            pad: number of the pad.
            wanted: size and media bus code.

        Returns:
            What the part made of it, which may be something else.
        """
        form = self._call(media_uapi.VIDIOC_SUBDEV_G_FMT, _format(pad))
        form.format.width, form.format.height = wanted.width_px, wanted.height_px
        form.format.code, form.format.field = wanted.code, media_uapi.FIELD_NONE
        return _pad_format(self._call(media_uapi.VIDIOC_SUBDEV_S_FMT, form))

    def crop_px(self, pad: int) -> tuple[int, int] | None:
        """The area of the sensor that is read out.

        Args:
            pad: number of the pad.

        Returns:
            Columns and rows, px; None where the sensor does not report them.
        """
        one = media_uapi.SubDeviceSelection(
            which=media_uapi.SUBDEV_FORMAT_ACTIVE, pad=pad, target=media_uapi.SEL_TGT_CROP
        )
        with contextlib.suppress(OSError):
            self._call(media_uapi.VIDIOC_SUBDEV_G_SELECTION, one)
            return int(one.r.width), int(one.r.height)
        return None


class SensorPipeline:
    """The opened parts from a sensor to a video node.

    Args:
        graph: of the media device.
        node: the part of the video node.

    Raises:
        DeviceError: no enabled way leads from a sensor to the node, or a part cannot be opened.
    """

    def __init__(self, graph: MediaGraph, node: Entity) -> None:
        self._graph = graph
        self._route = route_of(graph, node)
        self.parts: dict[int, SubDevice] = {}
        self.side_parts: list[SubDevice] = []
        for link in self._route:
            entity = graph.entities[link.source[0]]
            try:
                self.parts[entity.id] = SubDevice(entity.path)
            except OSError as error:
                self.close()
                raise DeviceError(
                    f"the part {entity.name} of its media pipeline at {entity.path or 'no node'} "
                    f"cannot be opened ({error.strerror}); add this user to the group video"
                ) from None
        sensor, self._sensor_pad = self._route[0].source
        self.sensor = self.parts[sensor]
        self.sensor_name = graph.entities[sensor].name

    def close(self) -> None:
        """Close all parts."""
        for part in self.parts.values():
            part.close()

    @property
    def sensor_format(self) -> PadFormat:
        """What the sensor sends."""
        return self.sensor.pad_format(self._sensor_pad)

    @property
    def is_scaled(self) -> bool:
        """Whether the sensor bins or skips: its output has another size than what it reads out."""
        crop, sent = self.sensor.crop_px(self._sensor_pad), self.sensor_format
        return crop is not None and crop != (sent.width_px, sent.height_px)

    def configure(self, width_px: int, height_px: int, pixel_format: str) -> list[str]:
        """Give every pad the same format, from the sensor on.

        Args:
            width_px: columns; 0 takes what the sensor is set to.
            height_px: rows; 0 takes what the sensor is set to.
            pixel_format: of the video node.

        Returns:
            A sentence for each refusal.

        Raises:
            OSError: a part is lost.
        """
        current, code = self.sensor_format, media_uapi.bus_code(pixel_format)
        offered = self.sensor.codes(self._sensor_pad) or [current.code]
        if code is None or code not in offered:
            names = ", ".join(dict.fromkeys(media_uapi.bus_name(each) for each in offered))
            return [
                f"pixel_format is {pixel_format!r}; the sensor {self.sensor_name} sends {names}; "
                "mirroring changes the order of colours"
            ]
        wanted = PadFormat(width_px or current.width_px, height_px or current.height_px, code)
        if refusal := self._set(self._route[0].source, wanted):
            return [refusal]
        for link, following in zip(self._route, self._route[1:], strict=False):
            for place in (link.sink, following.source):
                if refusal := self._set(place, wanted):
                    return [refusal]
        return self._set_side_branches(wanted)

    def _set_side_branches(self, wanted: PadFormat) -> list[str]:
        """Set parts that hang on the way: the kernel compares the formats of every enabled link.

        Source: media_pipeline_start in drivers/media/mc/mc-entity.c of the kernel.
        """
        sources = {link.source for link in self._route}
        refusals = []
        for link in self._graph.links:
            entity = self._graph.entities.get(link.sink[0])
            is_side = link.source in sources and link not in self._route and link.is_enabled
            if not is_side or entity is None or not entity.path.startswith("/dev/v4l-subdev"):
                continue
            if entity.id not in self.parts:
                try:
                    self.parts[entity.id] = SubDevice(entity.path)
                except OSError:
                    continue  # the kernel refuses to stream if it matters
                self.side_parts.append(self.parts[entity.id])
            if refusal := self._set(link.sink, wanted):
                refusals.append(
                    f"{refusal}; disable its link: media-ctl -d {self._graph.path} -l "
                    f"'{self._graph.described(link)} [0]'"
                )
        return refusals

    def _set(self, place: tuple[int, int], wanted: PadFormat) -> str:
        entity, pad = self._graph.entities[place[0]], place[1]
        try:
            found = self.parts[place[0]].set_pad_format(pad, wanted)
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.ENXIO):
                raise
            return (
                f"pad {pad} of {entity.name} refuses {wanted} ({error.strerror}); end the program "
                "that uses the media pipeline, see media-ctl -p"
            )
        if found == wanted:
            return ""
        return f"pad {pad} of {entity.name} gives {found} where {wanted} is configured"


def route_of(graph: MediaGraph, node: Entity) -> tuple[PadLink, ...]:
    """The enabled links from a sensor to a video node.

    Args:
        graph: of the media device.
        node: the part of the video node.

    Returns:
        Links, the sensor's first.

    Raises:
        DeviceError: there is no way, or a link on it is disabled.
    """
    if route := graph.route_to(node):
        return route
    possible = graph.route_to(node, enabled_only=False)
    if possible:
        # The first is where the picture stops; a later one may follow.
        commands = "; ".join(
            f"media-ctl -d {graph.path} -l '{graph.described(link)} [1]'"
            for link in possible
            if not link.is_enabled
        )
        raise DeviceError(f"a link of its media pipeline is disabled; run {commands}")
    raise DeviceError(
        "no sensor leads to this node in its media device: it is the output of an image processor, "
        "which streams only through libcamera; give the node of the sensor's receiver as device"
    )


def _format(pad: int) -> media_uapi.SubDeviceFormat:
    return media_uapi.SubDeviceFormat(which=media_uapi.SUBDEV_FORMAT_ACTIVE, pad=pad)


def _pad_format(form: media_uapi.SubDeviceFormat) -> PadFormat:
    return PadFormat(int(form.format.width), int(form.format.height), int(form.format.code))
