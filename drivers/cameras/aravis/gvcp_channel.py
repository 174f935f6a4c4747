"""A GVCP channel with control of a head, from opening to closing; without Aravis.

For short tests of a path. Flights use Aravis, which owns heartbeat and stream.

Source: GigE Vision 2.0, sections 14.3 (READREG), 14.4 (WRITEREG) and 28 (bootstrap registers).
"""

from __future__ import annotations

import contextlib
import secrets
import socket
import struct
import time
from types import TracebackType
from typing import Final

from drivers.cameras.aravis.gvcp import (
    ACK_REQUIRED,
    CONTROL_CHANNEL_PRIVILEGE,
    GVCP_PORT,
    KEY,
    PENDING_ACK,
    READREG_CMD,
    REQUEST_IDS,
    SUCCESS,
)
from drivers.contract import DeviceError

WRITEREG_CMD: Final = 0x0082
CONTROL_ACCESS: Final = 0x2
TIMEOUT_S: Final = 0.3
ATTEMPTS: Final = 3


class HeadBusyError(DeviceError):
    """Another program controls the head."""


class GvcpChannel:
    """Control of the head at an address while the context lasts.

    Raises:
        HeadBusyError: on entering, where another program controls the head.
        DeviceError: on entering, where nothing answers.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __enter__(self) -> GvcpChannel:
        try:
            self._socket.connect((self._address, GVCP_PORT))
            if self.read(CONTROL_CHANNEL_PRIVILEGE) != 0:
                raise HeadBusyError(f"another program controls the head at {self._address}")
            try:
                self.write(CONTROL_CHANNEL_PRIVILEGE, CONTROL_ACCESS)
            except DeviceError as error:
                raise HeadBusyError(str(error)) from None
        except OSError as error:
            self._socket.close()
            raise DeviceError(f"the head at {self._address} cannot be reached ({error})") from None
        except DeviceError:
            self._socket.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with contextlib.suppress(DeviceError, OSError):
            self.write(CONTROL_CHANNEL_PRIVILEGE, 0)
        self._socket.close()

    @property
    def local_address(self) -> str:
        """Address of this computer towards the head."""
        return str(self._socket.getsockname()[0])

    def read(self, register: int) -> int:
        """Read a register.

        Args:
            register: its address.

        Returns:
            Its value, 32 bits.

        Raises:
            DeviceError: no answer, or it is refused.
        """
        body = self._request(READREG_CMD, struct.pack(">I", register))
        if len(body) < 4:
            raise DeviceError(f"the head at {self._address} answers without a value")
        return int(struct.unpack_from(">I", body)[0])

    def write(self, register: int, value: int) -> None:
        """Write a register.

        Args:
            register: its address.
            value: 32 bits.

        Raises:
            DeviceError: no answer, or it is refused.
        """
        self._request(WRITEREG_CMD, struct.pack(">II", register, value))

    def _request(self, command: int, body: bytes) -> bytes:
        request_id = 1 + secrets.randbelow(REQUEST_IDS)
        packet = struct.pack(">BBHHH", KEY, ACK_REQUIRED, command, len(body), request_id) + body
        for _ in range(ATTEMPTS):
            with contextlib.suppress(ConnectionRefusedError):
                self._socket.send(packet)
            answer = self._answer(command, request_id)
            if answer is not None:
                status, found = answer
                if status != SUCCESS:
                    raise DeviceError(
                        f"the head at {self._address} refuses a command (status 0x{status:04x})"
                    )
                return found
        raise DeviceError(f"nothing answers at {self._address}")

    def _answer(self, command: int, request_id: int) -> tuple[int, bytes] | None:
        until_s = time.monotonic() + TIMEOUT_S
        while (left_s := until_s - time.monotonic()) > 0:
            self._socket.settimeout(left_s)
            try:
                packet = self._socket.recv(576)
            except OSError:
                return None
            if len(packet) < 8:
                continue
            status, code, _, answered = struct.unpack_from(">HHHH", packet)
            if answered == request_id and code == command + 1:
                return int(status), packet[8:]
            if answered == request_id and code == PENDING_ACK:
                until_s = time.monotonic() + TIMEOUT_S
        return None
