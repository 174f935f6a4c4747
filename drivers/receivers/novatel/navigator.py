"""A NovAtel OEM7 or SPAN receiver on a serial line or behind TCP.

What its bytes mean is in `drivers.receivers.novatel.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.base.settings import Setting
from drivers.receivers.novatel.decoder import NovatelDecoder
from drivers.receivers.streaming_navigator import StreamingNavigator


class NovatelNavigator(StreamingNavigator):
    """A NovAtel receiver that sends its logs by itself, binary or ASCII.

    Yields a NavSample for every inertial solution, or for every BESTPOS where there is none, and
    an EventMark for every edge of MARK1 to MARK4.

    Source: NovAtel OEM7 Commands and Logs Reference Manual, OM-20000169.
    """

    kind: ClassVar = "navigator"
    protocol = "NovAtel OEM7"
    required = ("INSPVAX", "INSPVA", "BESTPOS")

    mark_accuracy_ns = Setting(
        100, minimum=1, maximum=1_000_000_000, help="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> NovatelDecoder:
        return NovatelDecoder(self.name, mark_accuracy_ns=self.mark_accuracy_ns)
