"""An NMEA 0183 receiver on a serial line or behind TCP.

What its bytes mean is in `drivers.receivers.nmea.decoder`.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable
from typing import ClassVar, Final

from drivers.base.settings import Setting
from drivers.receivers.nmea.decoder import NmeaDecoder
from drivers.receivers.streaming_navigator import StreamingNavigator
from drivers.timescales.gps_time import GPS_EPOCH_DAY
from drivers.transport.serial_device import Sample, SerialLine

NOT_BEFORE_DAY: Final = datetime.date(2020, 1, 1).toordinal() - GPS_EPOCH_DAY
"""No flight was earlier: an earlier date means a week number rollover (1024 weeks)."""

UNDATED_MAX: Final = 5
"""So many positions before the first date are normal: it comes once a second."""


class NmeaNavigator(StreamingNavigator):
    """A receiver that sends NMEA 0183 sentences by itself.

    Yields a NavSample for every epoch with a fix and an EventMark for every $PTNL,EVT. What a
    receiver does not send is absent, as velocity down is as a rule; a sigma that is not sent is
    computed from the dilution of precision, and the sample states that.

    Source: NMEA 0183 as published in gpsd's "NMEA Revealed"; Trimble's $PTNL,EVT.
    """

    kind: ClassVar = "navigator"
    protocol = "NMEA 0183"
    required = ("RMC", "GGA", "GNS", "PTNL,GGK", "PUBX,00")

    range_error_m = Setting(
        5.0, minimum=0.001, maximum=1000, help="without GST, sigma is this times the HDOP"
    )
    undulation_m = Setting(
        0.0,
        minimum=-200,
        maximum=200,
        help="geoid above ellipsoid, m, for receivers that do not send it; if neither is known, "
        "heights are absent",
    )
    speed_sigma_mps = Setting(
        0.5, minimum=0.001, maximum=100, help="sigma of velocity, which NMEA does not contain"
    )
    mark_accuracy_ns = Setting(
        1000, minimum=1, maximum=1_000_000_000, help="accuracy of an event mark, by the data sheet"
    )

    def new_decoder(self) -> NmeaDecoder:
        return NmeaDecoder(
            self.name,
            range_error_m=self.range_error_m,
            speed_sigma_mps=self.speed_sigma_mps,
            mark_accuracy_ns=self.mark_accuracy_ns,
            undulation_m=self.undulation_m if "undulation_m" in self.given else None,
            not_before_day=NOT_BEFORE_DAY,
        )

    def step(self, line: SerialLine) -> Iterable[Sample]:
        records = super().step(line)
        counters = self.decoder.counters
        if counters["samples_without_date"] >= UNDATED_MAX and not counters["samples"]:
            self.emitter.emit_throttled(
                "no-date",
                f"The receiver {self.name} at {self.port} sends positions and no date. Switch on "
                "RMC or ZDA.",
            )
        if counters["dates_rolled_over"]:
            self.emitter.emit_throttled(
                "rolled-over",
                f"The receiver {self.name} at {self.port} sends dates of 1024 weeks ago; they are "
                "corrected. Update its firmware.",
            )
        return records
