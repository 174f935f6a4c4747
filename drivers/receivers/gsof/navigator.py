"""A Trimble receiver or an Applanix board that sends GSOF.

What its bytes mean is in `drivers.receivers.gsof.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.base.settings import Setting
from drivers.receivers.gsof.decoder import GsofDecoder
from drivers.receivers.streaming_navigator import StreamingNavigator


class GsofNavigator(StreamingNavigator):
    """A Trimble receiver (BD, BX, R, SPS, Alloy) or an Applanix board (AP+, APX) that sends GSOF.

    Yields a NavSample for every transmission with record 49, or with 1 and 2, and an EventMark
    for every record 51.

    Source: Trimble OEM GNSS receiver help, "GSOF messages: overview".
    """

    kind: ClassVar = "navigator"
    protocol = "GSOF"
    required = ("InsNavigation", "Llh")
    enable_hint = "select GSOF messages 1, 2, 8, 12, 16, 49, 50 and 51 for this port"

    mark_accuracy_ns = Setting(
        1000, minimum=1, maximum=1_000_000_000, help="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> GsofDecoder:
        return GsofDecoder(self.name, mark_accuracy_ns=self.mark_accuracy_ns)
