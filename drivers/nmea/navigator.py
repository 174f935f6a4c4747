"""An NMEA 0183 receiver on a serial line or behind TCP.

What its bytes mean is in `drivers.nmea.decoder`.
"""

from __future__ import annotations

from typing import ClassVar

from drivers.nmea.decoder import NmeaDecoder
from drivers.receiver import ListeningNavigator
from drivers.settings import Setting


class NmeaNavigator(ListeningNavigator):
    """A receiver that sends NMEA 0183 sentences by itself.

    Yields a NavSample for every epoch and an EventMark for every $PTNL,EVT. Velocity down is not
    in NMEA and is 0; sigmas that are not sent are those of the settings.

    Source: NMEA 0183 as published in gpsd's "NMEA Revealed"; Trimble's $PTNL,EVT.
    """

    kind: ClassVar = "navigator"
    protocol = "NMEA 0183"
    required = ("RMC", "GGA")

    range_error_m = Setting(
        5.0, minimum=0.001, maximum=1000, says="without GST, sigma is this times the HDOP"
    )
    speed_sigma_mps = Setting(
        0.5, minimum=0.001, maximum=100, says="sigma of velocity, which NMEA does not tell"
    )
    mark_accuracy_ns = Setting(
        1000, minimum=1, maximum=1_000_000_000, says="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> NmeaDecoder:
        return NmeaDecoder(
            self.name,
            range_error_m=self.range_error_m,
            speed_sigma_mps=self.speed_sigma_mps,
            mark_accuracy_ns=self.mark_accuracy_ns,
        )
