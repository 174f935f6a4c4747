"""A VectorNav inertial unit on a serial line or behind TCP.

What its bytes mean is in `drivers.receivers.vectornav.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.base.settings import Setting
from drivers.receivers.streaming_navigator import StreamingNavigator
from drivers.receivers.vectornav.decoder import VectornavDecoder


class VectornavNavigator(StreamingNavigator):
    """A VectorNav unit (VN-200, VN-210, VN-300, VN-310) that sends binary outputs by itself.

    Yields a NavSample for every output with TimeGps and a position, and an EventMark for every
    pulse on SyncIn.

    Source: VectorNav VN-200 user manual UM004, VN-300 user manual UM005.
    """

    kind: ClassVar = "navigator"
    protocol = "VectorNav binary"
    required = ("Position",)
    enable_hint = "configure a binary output with TimeGps, TimeStatus, Position and InsStatus"

    mark_accuracy_ns = Setting(
        1000, minimum=1, maximum=1_000_000_000, help="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> VectornavDecoder:
        return VectornavDecoder(self.name, mark_accuracy_ns=self.mark_accuracy_ns)
