"""GPS time from the clocks of heads that PTP synchronises, and whether it may be used.

PTP states that a head's clock follows its master, not that the master shows TAI. Therefore the
clocks are used only after they agreed with the receiver, and no longer than they do.

Source: docs/explanation/mathematics/time.md#ptp; IEEE 1588-2008, section 7.2 and annex B.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from daemon.onboard.timing.gps_clock import ClockEvent, GpsEstimate
from drivers.contract import PtpReading

SECOND_NS: Final = 1_000_000_000
TAI_LESS_GPS_S: Final = 19
GPS_EPOCH_PTP_NS: Final = (315_964_800 + TAI_LESS_GPS_S) * SECOND_NS
"""1980-01-06T00:00:00 UTC on the PTP timescale, TAI since 1970-01-01."""
TAI_LESS_UTC_S: Final = range(36, 40)
"""37 s since 2017; neighbours, should a leap second be announced."""
OFFSET_LIMIT_NS: Final = 1_000_000
"""A head whose clock is further from its master's is not synchronised."""
SIGMA_MIN_NS: Final = 1_000
OFFSETS_MAX: Final = 32
OFFSETS_MIN: Final = 3
RESIDUALS_MAX: Final = 32
RESIDUALS_MIN: Final = 3
SILENCE_NS: Final = 10 * SECOND_NS
"""A head that reports nothing for so long may have lost its master."""
COARSE_TOLERANCE_NS: Final = 450_000_000
"""Navigation messages are 0 to 700 ms late, and taken as 350 ms late."""
SIGMAS: Final = 5.0
EPOCH_TOLERANCE_NS: Final = 86_400 * SECOND_NS
"""Further off than a day no count of leap seconds is wrong: the master has an epoch of its own."""
OUTLIER_SIGMAS: Final = 6.0


def gps_ns_of_tai(tai_ns: int) -> int:
    """GPS time of an instant on the PTP timescale.

    Args:
        tai_ns: TAI since 1970-01-01T00:00:00 TAI, ns.

    Example:
        >>> gps_ns_of_tai(315_964_819_000_000_000)
        0
    """
    return tai_ns - GPS_EPOCH_PTP_NS


@dataclass(frozen=True)
class PtpInstant:
    """A GPS time with its standard deviation."""

    gps_ns: int
    sigma_ns: int


@dataclass
class _HeadState:
    """What is known of one head's synchronisation."""

    last: PtpReading | None = None
    grandmaster: str = ""
    offsets: deque[int] = field(default_factory=lambda: deque(maxlen=OFFSETS_MAX))
    residuals: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=RESIDUALS_MAX))
    """PTP less the receiver's time, and its sigma, ns."""
    fault: str = ""
    disagreement: str = ""
    """The name of the fault by comparison with the receiver; empty while they agree."""
    disagreement_ns: int = 0
    latched_ns: int | None = None
    since_ns: int = 0
    """The host's time of the reading with which the present synchronisation began."""
    has_new_master: bool = False
    """The grandmaster changed, and its time has not agreed with the receiver since."""

    def restart(self, mono_ns: int) -> None:
        self.since_ns = mono_ns
        self.offsets.clear()
        self.residuals.clear()
        self.disagreement = ""


class PtpTime:
    """The PTP clocks of all heads. A pure model: it reads no clock itself."""

    def __init__(self) -> None:
        self._heads: dict[str, _HeadState] = {}
        self._events: list[ClockEvent] = []
        self.counts: Counter[str] = Counter()

    def read(self, reading: PtpReading) -> None:
        """Note what a head reports of its synchronisation."""
        state = self._heads.setdefault(reading.device, _HeadState())
        state.last = reading
        changed = reading.grandmaster != state.grandmaster
        if reading.status == "Slave" and changed:
            if state.grandmaster:
                state.has_new_master = True
                self.counts["ptp-grandmaster-changed"] += 1
                self._events.append(
                    ClockEvent(
                        "ptp-grandmaster-changed",
                        True,
                        f"the grandmaster of {reading.device} is "
                        f"{reading.grandmaster or 'unknown'} and was {state.grandmaster}; its time "
                        "is used again once it agrees with the receiver. Check why the former one "
                        "left, and their priorities",
                    )
                )
            state.grandmaster = reading.grandmaster
            state.restart(reading.mono_ns)
        if reading.status != "Slave" or reading.offset_ns is None:
            state.restart(reading.mono_ns)
        elif abs(reading.offset_ns) > OFFSET_LIMIT_NS:
            state.offsets.clear()
        else:
            state.offsets.append(reading.offset_ns)
        self._judge(reading.device, state, reading.mono_ns)

    def compare(
        self,
        head: str,
        tai_ns: int,
        reference_ns: int,
        sigma_ns: float,
        *,
        mono_ns: int,
        is_coarse: bool = False,
    ) -> None:
        """Compare a head's clock with the receiver's time of the same instant.

        Args:
            head: its name.
            tai_ns: what the head's clock showed.
            reference_ns: GPS time of the receiver at that instant.
            sigma_ns: standard deviation of the difference, without that of the head's clock.
            mono_ns: that instant on the host's clock. One before the head's present synchronisation
                proves nothing of it.
            is_coarse: only navigation messages are known: large errors show, agreement does not.
        """
        state = self._heads.get(head)
        if state is None or state.last is None or mono_ns < state.since_ns:
            return
        difference_ns = gps_ns_of_tai(tai_ns) - reference_ns
        tolerance_ns = OFFSET_LIMIT_NS + SIGMAS * sigma_ns
        if is_coarse:
            tolerance_ns = COARSE_TOLERANCE_NS
        agrees = abs(difference_ns) <= tolerance_ns
        state.disagreement = "" if agrees else _name_of(difference_ns)
        state.disagreement_ns = 0 if agrees else difference_ns
        if not agrees:
            state.residuals.clear()
        elif not is_coarse:
            state.residuals.append((difference_ns, max(sigma_ns, 1.0)))
            if len(state.residuals) >= RESIDUALS_MIN:
                state.has_new_master = False
        self._judge(head, state, state.last.mono_ns)

    def compare_latch(
        self,
        head: str,
        tai_ns: int,
        reference: GpsEstimate | None,
        half_width_ns: int,
        *,
        mono_ns: int,
    ) -> None:
        """Compare a latch of a head's clock at `mono_ns` with the host's estimate of GPS time."""
        state = self._heads.get(head)
        if state is None or reference is None or tai_ns == state.latched_ns:
            return
        state.latched_ns = tai_ns
        sigma_ns = math.hypot(reference.sigma_ns, half_width_ns)
        is_coarse = reference.is_coarse
        self.compare(head, tai_ns, reference.gps_ns, sigma_ns, mono_ns=mono_ns, is_coarse=is_coarse)

    def at(self, head: str, tai_ns: int, mono_ns: int) -> PtpInstant | None:
        """GPS time of an instant on a head's clock; None while it may not be used.

        Args:
            head: its name.
            tai_ns: the instant on its clock.
            mono_ns: now, on the host's clock.
        """
        state = self._heads.get(head)
        if state is None or self._fault_of(state, mono_ns):
            return None
        if len(state.offsets) < OFFSETS_MIN or len(state.residuals) < RESIDUALS_MIN:
            return None
        spread_ns = math.sqrt(sum(o * o for o in state.offsets) / len(state.offsets))
        middle_ns = statistics.median(difference for difference, _ in state.residuals)
        reference_ns = statistics.median(sigma for _, sigma in state.residuals)
        # What is common to all comparisons may be the path's asymmetry: it stays in the sigma.
        common_ns = math.hypot(middle_ns, reference_ns / math.sqrt(len(state.residuals)))
        sigma_ns = math.ceil(max(SIGMA_MIN_NS, math.hypot(spread_ns, common_ns)))
        return PtpInstant(gps_ns_of_tai(tai_ns), sigma_ns)

    def is_suspect(self, heads: Iterable[str], mono_ns: int) -> bool:
        """Whether the PTP time of one of these heads may not be used: a fault, or a new master.

        Args:
            heads: names of heads; those without PTP are passed over.
            mono_ns: now, on the host's clock.
        """
        states = [self._heads[head] for head in heads if head in self._heads]
        return any(self._fault_of(state, mono_ns) or state.has_new_master for state in states)

    def events(self, mono_ns: int) -> list[ClockEvent]:
        """Events since the last call."""
        for head, state in self._heads.items():
            self._judge(head, state, mono_ns)
        events, self._events = self._events, []
        return events

    def _fault_of(self, state: _HeadState, mono_ns: int) -> str:
        last = state.last
        if last is None or last.status != "Slave":
            return "ptp-not-slave"
        if mono_ns - last.mono_ns > SILENCE_NS:
            return "ptp-silent"
        if last.offset_ns is None or abs(last.offset_ns) > OFFSET_LIMIT_NS:
            return "ptp-offset"
        return state.disagreement

    def _judge(self, head: str, state: _HeadState, mono_ns: int) -> None:
        fault = self._fault_of(state, mono_ns)
        if fault == state.fault:
            return
        before, state.fault = state.fault, fault
        if fault:
            self.counts[fault] += 1
            self._events.append(_fault_event(fault, head, state))
        else:
            self._events.append(
                ClockEvent(before, False, f"the PTP clock of {head} is synchronised again")
            )


def combined(instants: Iterable[PtpInstant]) -> PtpInstant | None:
    """One instant from those of several heads; None where they contradict each other.

    Heads of one master share its error, so the sigma does not shrink with their number.
    """
    found = sorted(instants, key=lambda instant: instant.gps_ns)
    if not found:
        return None
    middle = found[len(found) // 2]
    for other in found:
        limit_ns = OUTLIER_SIGMAS * math.hypot(other.sigma_ns, middle.sigma_ns)
        if abs(other.gps_ns - middle.gps_ns) > limit_ns:
            return None
    return PtpInstant(middle.gps_ns, max(instant.sigma_ns for instant in found))


def _name_of(difference_ns: int) -> str:
    """The fault that explains by how much PTP is ahead of the receiver."""
    if abs(difference_ns) > EPOCH_TOLERANCE_NS:
        return "ptp-arbitrary-epoch"
    seconds = round(difference_ns / SECOND_NS)
    if abs(difference_ns - seconds * SECOND_NS) <= COARSE_TOLERANCE_NS:
        if -seconds in TAI_LESS_UTC_S:
            return "ptp-utc"
        if -seconds == TAI_LESS_GPS_S:
            return "ptp-gps"
    return "ptp-disagrees"


def _fault_event(fault: str, head: str, state: _HeadState) -> ClockEvent:
    """The event of a fault: its reason and the remedy."""
    last, apart_s = state.last, state.disagreement_ns / SECOND_NS
    assert last is not None
    unused = f"the PTP clock of {head} is not used: "
    match fault:
        case "ptp-not-slave":
            return ClockEvent(
                "ptp-not-slave",
                True,
                f"{unused}its status is {last.status}. Check that the grandmaster runs, is on the "
                "same network, and has the better priority",
            )
        case "ptp-silent":
            return ClockEvent(
                "ptp-silent", True, f"{unused}it reports nothing. Check whether the head is lost"
            )
        case "ptp-offset":
            offset_ns = last.offset_ns
            shown = "not reported" if offset_ns is None else f"{offset_ns / 1e6:.3f} ms"
            return ClockEvent(
                "ptp-offset",
                True,
                f"{unused}its offset from the master is {shown}, the limit is "
                f"{OFFSET_LIMIT_NS / 1e6:g} ms. Check switches without PTP support and the "
                "network's load",
            )
        case "ptp-utc":
            return ClockEvent(
                "ptp-utc",
                True,
                f"{unused}its master serves UTC as TAI ({apart_s:.1f} s from the receiver). Set "
                "the master's clock to TAI, and its timescale to PTP",
            )
        case "ptp-gps":
            return ClockEvent(
                "ptp-gps",
                True,
                f"{unused}its master serves GPS time as TAI ({apart_s:.1f} s from the receiver). "
                "Set the grandmaster's timescale to PTP",
            )
        case "ptp-arbitrary-epoch":
            return ClockEvent(
                "ptp-arbitrary-epoch",
                True,
                f"{unused}its master's clock has an arbitrary epoch (timescale ARB). Set the "
                "grandmaster's clock, and its timescale to PTP",
            )
    return ClockEvent(
        "ptp-disagrees",
        True,
        f"{unused}it is {apart_s:+.4f} s off the receiver's time. Check the grandmaster's own "
        "reference and UTC offset, and the receiver",
    )
