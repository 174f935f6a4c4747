"""An emulated GigE Vision head: registers, control, acquisition and stream combined.

`expose` supplies the frames; this module is independent of cones, flights and scenes.
"""

from __future__ import annotations

import ipaddress
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from sim_hw.gige import features as at
from sim_hw.gige.acquisition import NO_PULSE, Acquisition, ExposureRequest
from sim_hw.gige.control import ControlChannel, HeadActions
from sim_hw.gige.gvcp import ForceIpRequest, Status
from sim_hw.gige.head_faults import NO_FAULTS, HeadClock, WireFaults, channel_of
from sim_hw.gige.interface_address import replace_address
from sim_hw.gige.pacing import Pacing
from sim_hw.gige.ptp_slave import PtpSlave
from sim_hw.gige.registers import FrameSize, HeadIdentity, RegisterMemory
from sim_hw.gige.server import ControlServer
from sim_hw.gige.stream import StreamChannel
from sim_hw.world.world_clock import NS_PER_S, FreeRunningClock

__all__ = [
    "NO_PULSE",
    "ExposureRequest",
    "FrameSize",
    "GigeHead",
    "HeadIdentity",
    "Pacing",
    "WireFaults",
]

RESET_S = 0.5
"""How long the head is deaf after DeviceReset."""

STATISTICS = (
    "pulses",
    "pulses_ignored",
    "software_triggers_ignored",
    "overtriggered",
    "exposures_cancelled",
    "frames_exposed",
    "frames_dropped_by_fault",
    "frames_unwanted",
    "frames_aborted",
    "frames_sent",
    "packets_sent",
    "packets_lost_by_fault",
    "packets_resent",
    "resend_requests",
    "resends_unavailable",
    "resends_refused",
    "send_errors",
    "receive_errors",
    "commands",
    "commands_refused",
    "commands_repeated",
    "commands_unknown",
    "garbage_packets",
    "actions",
    "actions_ignored",
    "actions_not_waited_for",
    "heartbeats_lost",
    "forced_addresses",
    "resets",
)
"""The names `GigeHead.statistics` always has."""


class GigeHead:
    """One head at `identity.address`, port 3956, from `start()` to `close()`.

    `expose` is called in the head's own thread, one exposure after another; it returns the whole
    sensor, uint16, shape (height, width), and must not change the array afterwards; what the pixel
    formats make of it is in `packing`. `temperature_c` gets a monotonic time in ns.
    `packet_pacing` defaults to what suits this host's rmem_max. `interface` is the interface of a
    network namespace that the head is; it then answers broadcasts there and takes an address by
    FORCEIP, until it is closed. `ptp` is the clock of a head that has PTP;
    one without it stays Disabled.
    """

    def __init__(
        self,
        identity: HeadIdentity,
        size: FrameSize,
        expose: Callable[[ExposureRequest], NDArray[np.uint16]],
        temperature_c: Callable[[int], float],
        clock: FreeRunningClock,
        faults: WireFaults = NO_FAULTS,
        packet_pacing: Pacing | None = None,
        interface: str = "",
        ptp: PtpSlave | None = None,
    ) -> None:
        self._ptp = ptp
        self.identity = identity
        self._interface = interface
        self.size = size
        self.channel = channel_of(faults, identity.serial)
        self._clock = HeadClock(clock, self.channel)
        self._registers = RegisterMemory(identity, size)
        self._stream = StreamChannel(
            identity.address,
            packet_pacing or Pacing.for_this_host(),
            faults,
            seed=zlib.crc32(identity.serial.encode("utf-8")),
            is_connected=lambda: self.channel.is_connected(time.monotonic_ns()),
        )
        self._acquisition = Acquisition(
            self._registers,
            self._stream,
            size,
            expose,
            temperature_c,
            self._clock,
            faults,
            self.channel,
        )
        self._registers.provide(
            "DeviceTemperature", lambda: struct.pack(">d", temperature_c(time.monotonic_ns()))
        )
        self._registers.provide("PtpStatus", lambda: struct.pack(">I", self._ptp_status()))
        self._registers.provide(
            "PayloadSize", lambda: struct.pack(">I", self._acquisition.payload_bytes())
        )
        self._control = ControlChannel(
            self._registers,
            HeadActions(
                written=self._written,
                resend=self._stream.resend,
                execute_action=self._acquisition.execute_action,
                control_lost=self._control_lost,
                is_acquiring=lambda: self._acquisition.is_acquiring,
                force_address=self._force_address,
            ),
        )
        self._server = ControlServer(
            identity.address, self._control, self._is_listening, interface, self._network
        )
        self._stream_port = 0
        self._counts: Counter[str] = Counter()

    @property
    def address(self) -> str:
        return self.identity.address

    def start(self) -> None:
        """Open the sockets and answer.

        Raises:
            OSError: the address is not this host's, or another head has it.
        """
        self._server.start()
        self._stream_port = self._stream.start()
        self._registers.set_register(at.STREAM_SOURCE_PORT, self._stream_port)
        self._acquisition.start(f"exposures-{self.address}")

    def close(self) -> None:
        """Stop and let go of the sockets. May be called twice."""
        self._server.close()
        if self._ptp is not None:
            self._ptp.close()
        self._acquisition.close()
        self._stream.close()

    def line(self, start_mono_ns: int, pulse_count: int) -> None:
        """The trigger pulse on Line1: the exposure starts at `start_mono_ns`.

        May be called somewhat before or after that moment, from any thread; never blocks.
        """
        self.channel.pulse(pulse_count, start_mono_ns)
        if self.channel.is_powered(start_mono_ns):
            self._acquisition.line_pulse(start_mono_ns, pulse_count)

    def statistics(self) -> Mapping[str, int]:
        """Counters since creation, by stable name."""
        total: Counter[str] = Counter()
        for part in (self._acquisition, self._stream, self._control, self._server):
            total.update(part.counts)
        total.update(self._counts)
        return {name: total[name] for name in STATISTICS}

    def _is_listening(self) -> bool:
        """Whether a command reaches the head; asked every quarter of a second at the latest."""
        now_ns = time.monotonic_ns()
        if self.channel.has_power_cycled(now_ns):
            self._clock.restart(now_ns)
            self._reset()
        return self.channel.is_connected(now_ns) and not self.channel.is_silent(now_ns)

    def _written(self, address: int) -> None:
        """What the write of a register sets in motion."""
        registers = self._registers
        if address == registers.address_of("AcquisitionStart"):
            self._acquisition.begin()
        elif address == registers.address_of("AcquisitionStop"):
            self._acquisition.end()
        elif address == registers.address_of("TriggerSoftware"):
            self._acquisition.software_trigger()
        elif address == registers.address_of("DeviceReset"):
            self._reset()
        elif address == registers.address_of("PtpEnable"):
            self._switch_ptp()
        elif address == registers.address_of("PtpDataSetLatch"):
            self._latch_ptp()
        elif address == at.TIMESTAMP_CONTROL:
            self._latch_timestamp()
        elif address == at.STREAM_PORT:
            self._acquisition.stream_opened()
            self._stream.discard_retained()
        elif address == at.STREAM_PACKET_SIZE:
            self._fire_test_packet()

    def _network(self) -> ipaddress.IPv4Network:
        """The subnet that the head believes to be in."""
        address, mask = (
            ipaddress.IPv4Address(self._registers.register(register))
            for register in (at.IP_ADDRESS, at.SUBNET_MASK)
        )
        return ipaddress.IPv4Network((address, str(mask)), strict=False)

    def _force_address(self, request: ForceIpRequest) -> Status:
        """FORCEIP: the head answers and sends from the new address."""
        if not self._interface:
            return Status.NOT_IMPLEMENTED
        old = str(ipaddress.IPv4Address(self._registers.register(at.IP_ADDRESS)))
        if not replace_address(self._interface, old, request.address, request.mask):
            return Status.INVALID_PARAMETER
        self._server.move_to(request.address)
        self._stream_port = self._stream.move_to(request.address)
        for register, value in (
            (at.IP_ADDRESS, request.address),
            (at.SUBNET_MASK, request.mask),
            (at.GATEWAY, request.gateway),
        ):
            self._registers.set_register(register, int(ipaddress.IPv4Address(value)))
        self._registers.set_register(at.STREAM_SOURCE_PORT, self._stream_port)
        self._counts["forced_addresses"] += 1
        return Status.SUCCESS

    def _latch_timestamp(self) -> None:
        if self._registers.register(at.TIMESTAMP_CONTROL) & at.TIMESTAMP_LATCH:
            now_ns = self._clock.device_ns(time.monotonic_ns())
            self._registers.set_register64(at.TIMESTAMP_VALUE, now_ns)
        self._registers.set_register(at.TIMESTAMP_CONTROL, 0)

    def _ptp_status(self) -> int:
        return at.PTP_STATUSES["Disabled" if self._ptp is None else self._ptp.status]

    def _switch_ptp(self) -> None:
        if self._ptp is None:
            return
        if self._registers.integer("PtpEnable"):
            try:
                self._ptp.start()
            except OSError:
                self._counts["ptp_start_failures"] += 1
            self._clock.ptp = self._ptp
        else:
            self._ptp.close()
            self._clock.ptp = None

    def _latch_ptp(self) -> None:
        if self._ptp is None:
            return
        registers, master = self._registers, self._ptp.master
        identities = (0, 0) if master is None else (master.grandmaster, master.parent_identity)
        for name, value in (
            ("PtpOffsetFromMaster", self._ptp.offset_ns),
            ("PtpGrandmasterClockID", identities[0]),
            ("PtpParentClockID", identities[1]),
        ):
            registers.set_register64(registers.address_of(name), value & 0xFFFF_FFFF_FFFF_FFFF)

    def _fire_test_packet(self) -> None:
        register = self._registers.register(at.STREAM_PACKET_SIZE)
        if not register & at.FIRE_TEST_PACKET:
            return
        self._registers.set_register(at.STREAM_PACKET_SIZE, register & ~at.FIRE_TEST_PACKET)
        destination = self._acquisition.destination()
        if destination is not None:
            self._stream.fire_test_packet(
                destination, may_fragment=not register & at.DO_NOT_FRAGMENT
            )

    def _control_lost(self) -> None:
        """A head without a controller sends nothing."""
        self._acquisition.abort()
        self._registers.set_register(at.STREAM_PORT, 0)
        self._stream.discard_retained()

    def _reset(self) -> None:
        self._counts["resets"] += 1
        self._server.ignore_until(time.monotonic_ns() + round(RESET_S * NS_PER_S))
        self._control.release()
        self._registers.reset()
        self._registers.set_register(at.STREAM_SOURCE_PORT, self._stream_port)
