"""The control channel of a head: privilege, heartbeat, reading and writing of registers.

Pure functions from request packet to answer packet; sockets and threads are in `gige_head`.
"""

from __future__ import annotations

import struct
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from sim_hw.gige import features as at
from sim_hw.gige.gvcp import (
    READ_MAX,
    CommandCode,
    ForceIpRequest,
    GvcpCommand,
    ResendRequest,
    Status,
    acknowledgement,
    parse_action,
    parse_command,
    parse_force_ip,
    parse_resend,
)
from sim_hw.gige.registers import RegisterRefusedError

Peer = tuple[str, int]
"""Address and port of whoever sent a packet."""

_PRIVILEGES = at.EXCLUSIVE_ACCESS | at.CONTROL_ACCESS
_NS_PER_MS = 1_000_000


@dataclass(frozen=True)
class HeadActions:
    """The actions of the head that the control channel triggers.

    `written` receives the address of every register that was written. `control_lost` is called when
    the privilege ends, given back or timed out.
    """

    written: Callable[[int], None]
    resend: Callable[[ResendRequest], None]
    execute_action: Callable[[int | None], Status]
    """An action command that meant this head: now, or when its clock shows so many ns."""
    control_lost: Callable[[], None]
    is_acquiring: Callable[[], bool]
    force_address: Callable[[ForceIpRequest], Status] = lambda _: Status.NOT_IMPLEMENTED
    """A FORCEIP command that meant this head while nobody controls it."""


class Registers(Protocol):
    """The registers behind a control channel; refusals raise `RegisterRefusedError`."""

    def read(self, address: int, length: int) -> bytes: ...

    def write(self, address: int, data: bytes, *, acquiring: bool = False) -> None: ...

    def register(self, address: int) -> int: ...

    def set_register(self, address: int, value: int) -> None: ...


class ControlChannel:
    """Answers GVCP packets. Never raises, whatever arrives: what is not GVCP is counted."""

    def __init__(self, registers: Registers, actions: HeadActions) -> None:
        self._registers = registers
        self._actions = actions
        self._controller: Peer | None = None
        self._last_command_ns = 0
        self._last_command: tuple[Peer, bytes, bytes] | None = None
        self._lock = threading.RLock()
        self.counts: Counter[str] = Counter()

    @property
    def controller(self) -> Peer | None:
        """Who holds the privilege."""
        return self._controller

    def answer(self, packet: bytes, peer: Peer, now_ns: int) -> bytes | None:
        """The acknowledgement of a packet, or None where none is due.

        `now_ns` is monotonic. Every command of the controller's is a heartbeat.
        """
        with self._lock:
            command = parse_command(packet)
            if command is None:
                self.counts["garbage_packets"] += 1
                return None
            self.counts["commands"] += 1
            self._expire(now_ns)
            if peer == self._controller:
                self._last_command_ns = now_ns
                if self._last_command is not None and self._last_command[:2] == (peer, packet):
                    # The acknowledgement was lost and the command came again: done already.
                    self.counts["commands_repeated"] += 1
                    return self._last_command[2]
            try:
                answer = self._execute(command, peer, now_ns)
            except RegisterRefusedError as refusal:
                self.counts["commands_refused"] += 1
                answer = acknowledgement(command, status=refusal.status)
            if answer is None or not command.wants_acknowledgement:
                return None
            if peer == self._controller:
                self._last_command = (peer, packet, answer)
            return answer

    def expire(self, now_ns: int) -> None:
        """Take the privilege from a controller that was silent for GevHeartbeatTimeout."""
        with self._lock:
            self._expire(now_ns)

    def release(self) -> None:
        """Forget the controller, as a reset does."""
        with self._lock:
            self._release_control()

    def _expire(self, now_ns: int) -> None:
        if self._controller is None:
            return
        timeout_ns = self._registers.register(at.HEARTBEAT_TIMEOUT) * _NS_PER_MS
        if now_ns - self._last_command_ns > timeout_ns:
            self.counts["heartbeats_lost"] += 1
            self._release_control()

    def _release_control(self) -> None:
        held = self._controller is not None
        self._controller = None
        self._last_command = None
        self._registers.set_register(at.CONTROL_PRIVILEGE, 0)
        if held:
            self._actions.control_lost()

    def _execute(self, command: GvcpCommand, peer: Peer, now_ns: int) -> bytes | None:
        match command.code:
            case CommandCode.DISCOVERY:
                return acknowledgement(command, self._registers.read(0, at.DISCOVERY_LENGTH))
            case CommandCode.READREG:
                return self._read_registers(command, peer)
            case CommandCode.WRITEREG:
                return self._write_registers(command, peer, now_ns)
            case CommandCode.READMEM:
                return self._read_memory(command, peer)
            case CommandCode.WRITEMEM:
                return self._write_memory(command, peer, now_ns)
            case CommandCode.FORCEIP:
                return self._force_address(command)
            case CommandCode.ACTION:
                return self._act(command)
            case CommandCode.PACKETRESEND:
                self._resend(command, peer)
                return None
            case _:
                self.counts["commands_unknown"] += 1
                return acknowledgement(command, status=Status.NOT_IMPLEMENTED)

    def _read_registers(self, command: GvcpCommand, peer: Peer) -> bytes:
        if not command.body or len(command.body) % 4 or len(command.body) > READ_MAX:
            raise RegisterRefusedError(Status.INVALID_HEADER)
        addresses = struct.unpack(f">{len(command.body) // 4}I", command.body)
        if addresses != (at.CONTROL_PRIVILEGE,):
            self._may_read(peer)
        register_bytes = b"".join(self._registers.read(address, 4) for address in addresses)
        return acknowledgement(command, register_bytes)

    def _read_memory(self, command: GvcpCommand, peer: Peer) -> bytes:
        if len(command.body) != 8:
            raise RegisterRefusedError(Status.INVALID_HEADER)
        address, _reserved, length = struct.unpack(">IHH", command.body)
        if length > READ_MAX:
            raise RegisterRefusedError(Status.INVALID_PARAMETER)
        self._may_read(peer)
        data = self._registers.read(address, length)
        return acknowledgement(command, command.body[:4] + data)

    def _write_registers(self, command: GvcpCommand, peer: Peer, now_ns: int) -> bytes:
        if not command.body or len(command.body) % 8 or len(command.body) > READ_MAX:
            raise RegisterRefusedError(Status.INVALID_HEADER)
        written, status = 0, Status.SUCCESS
        for offset in range(0, len(command.body), 8):
            (address,) = struct.unpack_from(">I", command.body, offset)
            try:
                self._write(address, command.body[offset + 4 : offset + 8], peer, now_ns)
            except RegisterRefusedError as refusal:
                self.counts["commands_refused"] += 1
                status = refusal.status
                break
            written += 1
        return acknowledgement(command, struct.pack(">HH", 0, written), status)

    def _write_memory(self, command: GvcpCommand, peer: Peer, now_ns: int) -> bytes:
        if len(command.body) < 8 or len(command.body) > READ_MAX + 4:
            raise RegisterRefusedError(Status.INVALID_HEADER)
        (address,) = struct.unpack_from(">I", command.body)
        self._write(address, command.body[4:], peer, now_ns)
        return acknowledgement(command, struct.pack(">HH", 0, len(command.body) - 4))

    def _write(self, address: int, data: bytes, peer: Peer, now_ns: int) -> None:
        if address == at.CONTROL_PRIVILEGE:
            self._change_privilege(data, peer, now_ns)
            return
        if peer != self._controller:
            raise RegisterRefusedError(Status.ACCESS_DENIED)
        self._registers.write(address, data, acquiring=self._actions.is_acquiring())
        self._actions.written(address)

    def _change_privilege(self, data: bytes, peer: Peer, now_ns: int) -> None:
        if len(data) != 4:
            raise RegisterRefusedError(Status.INVALID_PARAMETER)
        (requested_privilege,) = struct.unpack(">I", data)
        if self._controller not in (None, peer):
            raise RegisterRefusedError(Status.ACCESS_DENIED)
        if not requested_privilege & _PRIVILEGES:
            self._release_control()
            return
        self._controller = peer
        self._last_command_ns = now_ns
        self._registers.set_register(at.CONTROL_PRIVILEGE, requested_privilege & _PRIVILEGES)

    def _act(self, command: GvcpCommand) -> bytes | None:
        """An action command from any sender; a head that is not addressed sends no answer."""
        request = parse_action(command)
        if request is None:
            raise RegisterRefusedError(Status.INVALID_HEADER)
        registers = self._registers
        is_meant = (
            self._controller is not None
            and request.device_key == registers.register(at.ACTION_DEVICE_KEY)
            and request.group_key == registers.register(at.ACTION_GROUP_KEY)
            and request.group_mask & registers.register(at.ACTION_GROUP_MASK)
        )
        if not is_meant:
            self.counts["actions_ignored"] += 1
            return None
        self.counts["actions"] += 1
        return acknowledgement(command, status=self._actions.execute_action(request.device_ns))

    def _force_address(self, command: GvcpCommand) -> bytes | None:
        """A new address for the head with this MAC; the others send no answer."""
        request = parse_force_ip(command)
        if request is None:
            raise RegisterRefusedError(Status.INVALID_HEADER)
        if request.mac != self._registers.read(at.MAC_HIGH, 8)[2:]:
            return None
        if self._controller is not None:
            raise RegisterRefusedError(Status.ACCESS_DENIED)
        return acknowledgement(command, status=self._actions.force_address(request))

    def _may_read(self, peer: Peer) -> None:
        if self._controller in (None, peer):
            return
        if self._registers.register(at.CONTROL_PRIVILEGE) & at.EXCLUSIVE_ACCESS:
            raise RegisterRefusedError(Status.ACCESS_DENIED)

    def _resend(self, command: GvcpCommand, peer: Peer) -> None:
        request = parse_resend(command.body)
        # The request comes from the controller's stream socket, so its port is another one.
        if request is None or self._controller is None or peer[0] != self._controller[0]:
            self.counts["resends_refused"] += 1
            return
        self._actions.resend(request)
