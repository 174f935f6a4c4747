"""An opened GenICam head: its state, read between frames, from opening to closing or loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from drivers import DriverError
from drivers.cameras.aravis.camera import AravisCamera, ClockLatch
from drivers.cameras.aravis.gvcp import control_privilege
from drivers.cameras.aravis.stream import FrameStream
from drivers.contract import PtpReading

PROBE_TIMEOUT_S: Final = 0.2
LOSS_GRACE_S: Final = 2.0
"""Time without any answer after which a head is lost; shorter pauses are tolerated."""
CLOCK_DRIFT: Final = 100e-6
"""Maximum drift of a head's clock against the host's between two latches, relative."""


class AravisHeadLostError(DriverError):
    """The head is lost; internal."""


@dataclass
class HeadSession:
    """An opened head.

    `latch` is the last pair of its clock and the host's, `temperature_c` and `ptp` the last
    readings, each None where the head has none. `loss_suspected_ns` is when it first did not
    answer, CLOCK_MONOTONIC; None while it answers.
    """

    camera: AravisCamera
    stream: FrameStream
    latch: ClockLatch | None = None
    temperature_c: float | None = None
    ptp: PtpReading | None = None
    loss_suspected_ns: int | None = None
    is_lost: bool = False

    def description(self) -> Mapping[str, str]:
        """What the head is and how it is set, for the operator.

        Returns:
            As `drivers.cameras.aravis.aravis_head.AravisHead.bind`.
        """
        camera, latch = self.camera, self.latch
        frame, link_mbps, celsius = camera.geometry, camera.link_mbps, self.temperature_c
        return {
            **camera.identity,
            "frame": f"{frame.width_px} x {frame.height_px} {frame.pixel_format}",
            "packet_size": str(camera.frame_settings.get("GevSCPSPacketSize", "")),
            "link": "" if link_mbps is None else f"{link_mbps:g} Mbit/s",
            "chunks": ", ".join(camera.chunks) or f"no: {camera.chunks_missing}",
            "features": ", ".join(f"{k} = {v}" for k, v in camera.held.items()),
            "clock": "no" if latch is None else f"+-{latch.sigma_ns / 1e3:.0f} us",
            "temperature": "" if celsius is None else f"{celsius:.1f} degC",
        }

    def clock_at(self, mono_ns: int) -> tuple[int, int] | None:
        """The head's clock at a host time near now.

        Args:
            mono_ns: CLOCK_MONOTONIC, ns.

        Returns:
            Time on the head's clock, ns, and its sigma, ns, with CLOCK_DRIFT since the last latch;
            None while it is unknown.
        """
        latch = self.latch
        if latch is None:
            return None
        away_ns = mono_ns - latch.mono_ns
        drift_ns = round(abs(away_ns) * CLOCK_DRIFT)
        return latch.device_clock_ns + away_ns, latch.sigma_ns + drift_ns

    def check_answering(self, address: str, mono_ns: Callable[[], int]) -> bool:
        """Ask the head who controls it.

        Args:
            address: its IP address.
            mono_ns: CLOCK_MONOTONIC, ns; read after the answer or its time-out.

        Returns:
            Whether it answered; False during the first two seconds without an answer.

        Raises:
            AravisHeadLostError: it has not answered for two seconds, or was restarted.
        """
        privilege = control_privilege(address, timeout_s=PROBE_TIMEOUT_S)
        now_ns = mono_ns()
        if privilege is None:
            if self.loss_suspected_ns is None:
                self.loss_suspected_ns = now_ns
            if now_ns - self.loss_suspected_ns > LOSS_GRACE_S * 1e9:
                raise AravisHeadLostError(f"it has not answered for {LOSS_GRACE_S:g} s")
            return False
        self.loss_suspected_ns = None
        if privilege == 0:
            raise AravisHeadLostError("it has been restarted")
        return True

    def read(self, name: str, mono_ns: int) -> None:
        """Read clock, temperature and PTP; a head that has none of the first two is only asked.

        Args:
            name: of the head, for the reading of PTP.
            mono_ns: CLOCK_MONOTONIC, ns, of the reading of PTP.

        Raises:
            GLib.Error: the head does not answer.
        """
        self.latch = self.camera.latch()
        self.temperature_c = self.camera.thermometer.read_c()
        if self.camera.ptp is not None:
            self.ptp = self.camera.ptp.read(name, mono_ns)
        if self.latch is None and self.temperature_c is None:
            self.camera.check_alive()
