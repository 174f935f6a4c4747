"""A u-blox receiver on a serial line or behind TCP.

What its bytes mean is in `drivers.receivers.ublox.decoder`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from drivers.receivers.streaming_navigator import EDGE, StreamingNavigator
from drivers.receivers.ublox.decoder import UbxDecoder


class UbloxNavigator(StreamingNavigator):
    """A u-blox receiver (M8 or later) that sends UBX by itself.

    Yields a NavSample for every NAV-PVT and an EventMark for every edge of TIM-TM2 of the kind
    `edge`. The receiver's configuration is left as it is; it has to send NAV-PVT, TIM-TM2,
    NAV-TIMEGPS and NAV-TIMELS on this port, with a navigation rate above the exposure rate, because
    TIM-TM2 holds only the last edge of an epoch.

    Source: u-blox M8 receiver description UBX-13003221.
    """

    kind: ClassVar = "navigator"
    protocol = "UBX"
    required = ("NAV-PVT",)
    enable_hint = "switch on UBX-NAV-PVT and UBX-TIM-TM2 for this port"

    edge = EDGE

    decoder: UbxDecoder

    def new_decoder(self) -> UbxDecoder:
        return UbxDecoder(self.name, edge=self.edge)

    def undecodable_sentence(self) -> str:
        if self.decoder.other_bytes > self.decoder.bad_bytes:
            return (
                f"the receiver at {self.port} sends text only; switch its output to UBX "
                "(UBX-NAV-PVT, UBX-TIM-TM2)"
            )
        return (
            f"what comes at {self.port} makes no sense at {self.baudrate} bit/s; set baudrate to "
            "the receiver's"
        )

    def statistics(self) -> Mapping[str, int]:
        """Those of every receiver, and `other_bytes`: text."""
        return {**super().statistics(), "other_bytes": self.decoder.other_bytes}
