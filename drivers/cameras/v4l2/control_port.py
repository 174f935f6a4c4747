"""A node of the kernel that has controls: a video node or a sub-device.

A video node of a media pipeline has no controls of the sensor; they are on its sub-device. Several
nodes are read and written as one by `ControlPort.attach`.

Source: Documentation/userspace-api/media/v4l/extended-controls.rst of the kernel.
"""

from __future__ import annotations

import ctypes
import dataclasses
import errno
import fcntl
import os
from collections.abc import Mapping
from typing import Any

from drivers.cameras.v4l2 import uapi
from drivers.cameras.v4l2.control import NUMBERS, Control, control_name


class ControlPort:
    """An opened node and its controls.

    Args:
        path: of the node.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._attached: list[ControlPort] = []
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def attach(self, port: ControlPort) -> None:
        """Read and write the controls of another node as those of this one, until `close`.

        Where both have a control of the same name, the one attached first counts, then this one.

        Args:
            port: the other node, opened.
        """
        self._attached.append(port)

    def close(self) -> None:
        """Close the node and those attached to it."""
        for port in self._attached:
            port.close()
        self._attached.clear()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def controls(self) -> dict[str, Control]:
        """All controls except classes, strings and compounds.

        Returns:
            Controls by name.

        Raises:
            OSError: the head is lost.
        """
        found: dict[str, Control] = {}
        for port in self._attached:
            for name, control in port.controls().items():
                found.setdefault(name, dataclasses.replace(control, path=port.path))
        return {**self._own_controls(), **found}

    def queried(self, control: Control) -> Control:
        """Ask for the bounds of a control, which other controls may have changed.

        Args:
            control: the control.

        Returns:
            The control with the bounds it has now.

        Raises:
            OSError: the head is lost.
        """
        if (port := self._port_of(control)) is not self:
            return dataclasses.replace(port.queried(control), path=control.path)
        query = self._call(uapi.QUERY_EXT_CTRL, uapi.QueryExtCtrl(id=control.id))
        return dataclasses.replace(
            control, minimum=int(query.minimum), maximum=int(query.maximum), path=""
        )

    def _port_of(self, control: Control) -> ControlPort:
        return next((port for port in self._attached if port.path == control.path), self)

    def _own_controls(self) -> dict[str, Control]:
        found: dict[str, Control] = {}
        query = uapi.QueryExtCtrl(id=uapi.CTRL_FLAG_NEXT_CTRL)
        while True:
            try:
                self._call(uapi.QUERY_EXT_CTRL, query)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):
                    return found
                raise
            usable = query.type in (*NUMBERS, uapi.CTRL_TYPE_BUTTON) and query.elems <= 1
            if usable and not query.flags & uapi.CTRL_FLAG_DISABLED:
                name = control_name(text_of(query.name))
                found[name] = Control(
                    int(query.id),
                    name,
                    int(query.type),
                    int(query.minimum),
                    int(query.maximum),
                    int(query.flags),
                )
            query = uapi.QueryExtCtrl(id=query.id | uapi.CTRL_FLAG_NEXT_CTRL)

    def read(self, control: Control) -> int:
        """Read a control.

        Args:
            control: a control with a value.

        Returns:
            Its value, in the control's own unit.

        Raises:
            OSError: it cannot be read now, or the head is lost.
        """
        if (port := self._port_of(control)) is not self:
            return port.read(control)
        one = uapi.ExtControl(id=control.id)
        self._control(uapi.G_EXT_CTRLS, one)
        is_wide = control.type == uapi.CTRL_TYPE_INTEGER64
        return int(one.u.value64 if is_wide else one.u.value)

    def write(self, control: Control, value: int) -> None:
        """Write a control.

        Args:
            control: the control.
            value: value in the control's own unit; 1 for a button.

        Raises:
            OSError: the head refuses or is lost.
        """
        if (port := self._port_of(control)) is not self:
            port.write(control, value)
            return
        one = uapi.ExtControl(id=control.id)
        if control.type == uapi.CTRL_TYPE_INTEGER64:
            one.u.value64 = value
        else:
            one.u.value = value
        self._control(uapi.S_EXT_CTRLS, one)

    def read_all(self, controls: Mapping[str, Control]) -> dict[str, int]:
        """Read several controls.

        Args:
            controls: controls by name.

        Returns:
            Values by name of those that can be read now.

        Raises:
            OSError: ENODEV, the head is lost.
        """
        found: dict[str, int] = {}
        for name, control in controls.items():
            if not control.is_readable_number:
                continue
            try:
                found[name] = self.read(control)
            except OSError as error:
                if error.errno == errno.ENODEV:
                    raise
        return found

    def _control(self, request: int, one: uapi.ExtControl) -> None:
        several = uapi.ExtControls(which=uapi.CTRL_WHICH_CUR_VAL, count=1)
        several.controls = ctypes.pointer(one)
        self._call(request, several)

    def _call(self, request: int, argument: Any) -> Any:
        if self._fd < 0:
            raise OSError(errno.ENODEV, "the node is closed")
        while True:
            try:
                fcntl.ioctl(self._fd, request, argument)
            except InterruptedError:
                continue
            return argument


def text_of(value: bytes) -> str:
    """A text of the kernel, which may hold any bytes.

    Args:
        value: as it came.

    Returns:
        The text without blanks around it.
    """
    return value.decode("utf-8", errors="replace").strip()
