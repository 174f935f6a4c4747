"""An Xsens MTi inertial unit on a serial line or behind TCP.

What its bytes mean is in `drivers.receivers.xsens.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.base.settings import Setting
from drivers.receivers.streaming_navigator import EDGE, StreamingNavigator
from drivers.receivers.xsens.decoder import XsensDecoder


class XsensNavigator(StreamingNavigator):
    """An Xsens MTi with a GNSS receiver (MTi-G-710, MTi-670, MTi-680) that sends MTData2 by itself.

    Yields a NavSample for every message with LatLon, and an EventMark for every TriggerIn.

    Source: Xsens MT Low-Level Communication Protocol Documentation, document MT0101P.
    """

    kind: ClassVar = "navigator"
    protocol = "Xsens MTData2"
    required = ("LatLon",)
    enable_hint = "configure UtcTime, SampleTimeFine, StatusWord, LatLon and AltitudeEllipsoid"

    edge = EDGE
    mark_accuracy_ns = Setting(
        100_000,
        minimum=1,
        maximum=1_000_000_000,
        help="accuracy of an event mark, by the data sheet",
    )

    def new_decoder(self) -> XsensDecoder:
        return XsensDecoder(self.name, edge=self.edge, mark_accuracy_ns=self.mark_accuracy_ns)
