"""An Applanix POS AV on one of its data ports.

What its bytes mean is in `drivers.receivers.applanix.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.base.settings import Setting
from drivers.receivers.applanix.decoder import ApplanixDecoder
from drivers.receivers.streaming_navigator import StreamingNavigator


class ApplanixNavigator(StreamingNavigator):
    """An Applanix system (POS AV, POS MV, AP) that sends groups on a data port by itself.

    Yields a NavSample for every group 1 and an EventMark for every event group.

    Source: Applanix POS AV and POS MV V5 user interface control documents, PUBS-ICD-004089.
    """

    kind: ClassVar = "navigator"
    protocol = "Applanix groups"
    required = ("Navigation",)
    enable_hint = "select groups 1, 2, 3, 5 and 7 for this data port"

    mark_accuracy_ns = Setting(
        1000, minimum=1, maximum=1_000_000_000, help="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> ApplanixDecoder:
        return ApplanixDecoder(self.name, mark_accuracy_ns=self.mark_accuracy_ns)
