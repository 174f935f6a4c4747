"""The clock of a head disciplined by PTP (IEEE 1588): its features, and what it reports.

SFNC 2.3 and later name them Ptp..., heads before it GevIEEE1588.... A head reports neither the
timescale of its master nor its UTC offset: whether its clock shows TAI is found in
`daemon.onboard.timing.ptp_time`.

Source: GenICam SFNC 2.7, chapter 26 "PTP control"; GigE Vision 2.0, section 7.1.
"""

from __future__ import annotations

import contextlib
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.contract import PtpReading

SLAVE: Final = "Slave"
UNREADABLE: Final = "unreadable"
"""Status of a head that does not return it."""
SWITCHES: Final = ("PtpEnable", "GevIEEE1588")
LATCHES: Final = ("PtpDataSetLatch", "GevIEEE1588DataSetLatch")
STATUSES: Final = ("PtpStatus", "GevIEEE1588StatusLatched", "GevIEEE1588Status")
OFFSETS: Final = ("PtpOffsetFromMaster", "GevIEEE1588OffsetFromMaster")
MASTERS: Final = (
    "PtpGrandmasterClockID",
    "PtpParentClockID",
    "GevIEEE1588ParentClockId",
)


class PtpFeatures:
    """The PTP features of an opened head.

    Args:
        features: of the head.
    """

    def __init__(self, features: Features) -> None:
        self._features = features
        self._switch = features.first_available(SWITCHES)
        self._latch = next((n for n in LATCHES if features.kind(n) == "command"), None)
        self._status = features.first_available(STATUSES)
        self._offset = features.first_available(OFFSETS)
        self._master = features.first_available(MASTERS)

    def enable(self) -> str:
        """Switch PTP on.

        Returns:
            A sentence if that is refused, otherwise empty.
        """
        if self._switch is None or self._status is None:
            return (
                "ptp is true; the head offers neither PtpEnable with PtpStatus nor GevIEEE1588, "
                "set ptp = false"
            )
        try:
            self._features.set(self._switch, True)
        except FeatureError as error:
            return f"ptp is true; {self._switch} is refused ({error}), set ptp = false"
        return ""

    def read(self, device: str, mono_ns: int) -> PtpReading:
        """What the head reports now.

        Args:
            device: name of the head.
            mono_ns: CLOCK_MONOTONIC, ns.

        Returns:
            The reading; what the head does not return is absent in it.
        """
        if self._latch is not None:
            # Without a master the command may be refused; the other features can still be read.
            with contextlib.suppress(FeatureError):
                self._features.execute(self._latch)
        return PtpReading(
            device,
            mono_ns,
            self._text(self._status) or UNREADABLE,
            self._integer(self._offset),
            self._identity(),
        )

    def _text(self, name: str | None) -> str:
        return "" if name is None else self._features.text(name)

    def _integer(self, name: str | None) -> int | None:
        if name is None:
            return None
        try:
            value = self._features.get(name)
        except FeatureError:
            return None
        return int(value) if isinstance(value, int | float) else None

    def _identity(self) -> str:
        """The identity of a clock as ptp4l prints it: 16 hexadecimal digits."""
        number = self._integer(self._master)
        if number is None or number == 0:
            return ""
        return f"{number & 0xFFFF_FFFF_FFFF_FFFF:016x}"
