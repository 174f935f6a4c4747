"""An SBG Systems inertial unit on a serial line or behind TCP or UDP.

What its bytes mean is in `drivers.receivers.sbg.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.base.settings import Setting
from drivers.receivers.sbg.decoder import SbgDecoder
from drivers.receivers.streaming_navigator import StreamingNavigator


class SbgNavigator(StreamingNavigator):
    """An SBG inertial unit (Ellipse, Ekinox, Quanta, Apogee) that sends sbgECom logs by itself.

    Yields a NavSample for every EKF_NAV and an EventMark for every event of its Sync In pins.

    Source: SBG Systems, sbgECom binary protocol and messages reference, version 5.
    """

    kind: ClassVar = "navigator"
    protocol = "sbgECom"
    required = ("EKF_NAV",)
    enable_hint = "switch EKF_NAV, EKF_EULER and UTC_TIME on for this port"

    mark_accuracy_ns = Setting(
        1000, minimum=1, maximum=1_000_000_000, help="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> SbgDecoder:
        return SbgDecoder(self.name, mark_accuracy_ns=self.mark_accuracy_ns)
