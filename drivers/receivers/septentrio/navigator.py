"""A Septentrio receiver on a serial line or behind TCP.

What its bytes mean is in `drivers.receivers.septentrio.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.base.settings import Setting
from drivers.receivers.septentrio.decoder import SbfDecoder
from drivers.receivers.streaming_navigator import EDGE, StreamingNavigator


class SeptentrioNavigator(StreamingNavigator):
    """A Septentrio receiver that sends SBF by itself.

    Yields a NavSample for every INSNavGeod, or for every PVTGeodetic where there is none, and an
    EventMark for every ExtEvent of the kind `edge`. The receiver's configuration is left as it is.

    Source: Septentrio mosaic-X5 reference guide, firmware 4.14.
    """

    kind: ClassVar = "navigator"
    protocol = "SBF"
    required = ("PVTGeodetic", "INSNavGeod")
    enable_hint = "switch on PVTGeodetic and ExtEvent for this port (setSBFOutput)"

    edge = EDGE
    mark_accuracy_ns = Setting(
        100, minimum=1, maximum=1_000_000_000, help="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> SbfDecoder:
        return SbfDecoder(self.name, edge=self.edge, mark_accuracy_ns=self.mark_accuracy_ns)
