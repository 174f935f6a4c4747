"""What became of every pulse of a fast flight, and how its records compare with that.

The flight itself is in `benchmarks.fast_flight`; what is true only
`sim_hw.processes.discrete_event_rig` knows.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from daemon.mission.exposure import Exposure, NavigationRecord
from sim_hw.processes.discrete_event_rig import EARTH_M_PER_DEG, DiscreteEventRig
from sim_hw.world.world_clock import NS_PER_S

NAV_TOLERANCE_M = 1.0
SIGMAS = 6
RECOVERY_NS = 3 * NS_PER_S
"""After a fault of a whole device: a head's clock is read every 2 s, a mark comes within one."""


@dataclass
class PulseTruth:
    """What became of one pulse that was given."""

    number: int
    ordered_ns: int
    frames: set[str] = field(default_factory=set)
    """Heads whose frame of this pulse came whole and in time."""
    mark_received: bool = False


@dataclass
class Score:
    """Records of a flight against the truth; counts of pairs unless stated otherwise."""

    exposures: int = 0
    sealed: int = 0
    frames_received: int = 0
    frames_right: int = 0
    frames_wrong: int = 0
    marks_received: int = 0
    marks_right: int = 0
    marks_wrong: int = 0
    pairs: int = 0
    """Of one head and one exposure, whose frame and mark both came."""
    pairs_matched: int = 0
    untouched: int = 0
    """Exposures of which everything came, and nothing was touched by a fault."""
    untouched_matched: int = 0
    navigation_wrong: int = 0
    times_wrong: int = 0
    """Times without a mark that are further off than six of their sigmas."""
    hangs: int = 0
    imbalances: int = 0
    occurrences: int = 0
    longest_open_s: float = 0.0
    examples: list[str] = field(default_factory=list)

    @property
    def wrong(self) -> int:
        """Wrong pairings of any kind."""
        return self.frames_wrong + self.marks_wrong + self.navigation_wrong

    def add_example(self, sentence: str) -> None:
        """Keep the first few examples of what went wrong."""
        if len(self.examples) < 8:
            self.examples.append(sentence)


@dataclass(frozen=True)
class Comparison:
    """The records of a flight, the truth, and the score to be filled.

    `truth` is by exposure; `stored_pixels` is the exposure whose pixels were
    stored, by number of the record and head; `open_s` are the seconds each exposure was open.
    """

    clockwork: DiscreteEventRig
    heads: Collection[str]
    truth: Mapping[int, PulseTruth]
    records: Sequence[Exposure]
    stored_pixels: Mapping[int, Mapping[str, int]]
    open_s: Sequence[float]
    score: Score

    def compare(self) -> None:
        """Fill the score."""
        score = self.score
        exposure_of = {number: exposure for exposure, number in self.clockwork.pulses.items()}
        complete_exposures: dict[int, Exposure] = {}
        marked: set[int] = set()
        for record in self.records:
            score.sealed += 1
            exposure = exposure_of.get(record.number, 0)
            complete_exposures[exposure] = record
            self._compare_frames(record, exposure)
            if self._compare_mark(record, exposure):
                marked.add(exposure)
            if exposure:
                self._compare_navigation(record, exposure)
        touched = self._touched()
        heads = set(self.heads)
        for exposure, truth in self.truth.items():
            pixels = self.stored_pixels.get(truth.number, {})
            score.frames_received += len(truth.frames)
            score.marks_received += truth.mark_received
            matched = {
                h
                for h in truth.frames
                if pixels.get(h) == exposure and exposure in complete_exposures
            }
            if truth.mark_received:
                score.pairs += len(truth.frames)
                score.pairs_matched += len(matched) if exposure in marked else 0
            if truth.mark_received and truth.frames == heads and exposure not in touched:
                score.untouched += 1
                is_matched = matched == heads and exposure in marked
                score.untouched_matched += is_matched
                if not is_matched:
                    score.add_example(
                        f"exposure {truth.number}: untouched, but {len(matched)} frames and "
                        f"{'the' if exposure in marked else 'no'} mark"
                    )
        score.occurrences = sum(
            len(channel.occurrences) for channel in self.clockwork.channels.values()
        )
        score.longest_open_s = max(self.open_s, default=0.0)

    def _compare_frames(self, record: Exposure, exposure: int) -> None:
        pixels = self.stored_pixels.get(record.number, {})
        for frame in record.frames:
            if pixels.get(frame.sensor) == exposure:
                self.score.frames_right += 1
            else:
                self.score.frames_wrong += 1
                self.score.add_example(
                    f"exposure {record.number}: {frame.sensor} has the pixels of pulse "
                    f"{pixels.get(frame.sensor)}, its pulse is {exposure}"
                )

    def _compare_mark(self, record: Exposure, exposure: int) -> bool:
        """Whether the record has the mark of its own pulse."""
        gps_ns, sigma_ns = record.mark_gps_ns, record.mark_sigma_ns
        if gps_ns is None or sigma_ns is None:
            return False
        if record.mark_source == "event-mark":
            sent_marks = self.clockwork.receiver.sent_marks.get(gps_ns)
            if sent_marks is not None and sent_marks.exposure == exposure:
                self.score.marks_right += 1
                return True
            self.score.marks_wrong += 1
            self.score.add_example(
                f"exposure {record.number}: has the mark of pulse "
                f"{None if sent_marks is None else sent_marks.exposure}, its pulse is {exposure}"
            )
            return False
        if exposure:
            error_ns = gps_ns - self.clockwork.true_strobe_gps_ns[exposure]
            if abs(error_ns) > SIGMAS * sigma_ns and not self._receiver_clock_is_at_fault:
                self.score.times_wrong += 1
                self.score.add_example(
                    f"exposure {record.number}: {record.mark_source} time is off by "
                    f"{error_ns / 1e6:.3f} ms, its sigma is {sigma_ns / 1e6:.3f} ms"
                )
        return False

    @property
    def _receiver_clock_is_at_fault(self) -> bool:
        """Its time is then wrong, which is undetectable on board."""
        names = {hit.fault for hit in self.clockwork.receiver.channel.occurrences}
        return bool(names & {"clock-step", "clock-drift", "wrong-week"})

    def _compare_navigation(self, record: Exposure, exposure: int) -> None:
        if record.navigation is None:
            return
        error_m = self._navigation_error_m(record.navigation, exposure)
        # Two seconds without a position leave the turn out: 1.2 m on this track.
        limit_m = NAV_TOLERANCE_M * (1.0 if record.navigation.method == "interpolated" else 3.0)
        if record.mark_sigma_ns is not None:
            limit_m += SIGMAS * record.mark_sigma_ns * 1e-9 * 65.0
        if error_m > limit_m:
            self.score.navigation_wrong += 1
            self.score.add_example(
                f"exposure {record.number}: its position is {error_m:.1f} m off "
                f"({record.navigation.method}, {record.mark_source})"
            )

    def _navigation_error_m(self, navigation: NavigationRecord, exposure: int) -> float:
        gps_ns = self.clockwork.true_strobe_gps_ns[exposure]
        state = self.clockwork.receiver.state(gps_ns)
        north_m = (navigation.latitude_deg - state.latitude_deg) * EARTH_M_PER_DEG
        east_m = (navigation.longitude_deg - state.longitude_deg) * EARTH_M_PER_DEG * 0.669
        if navigation.height_m is None:
            return math.inf
        return math.hypot(north_m, east_m, navigation.height_m - state.height_m)

    def _touched(self) -> set[int]:
        """Exposures that a fault had to do with: named by it, or taken while it lasted."""
        touched: set[int] = set()
        spans: list[tuple[int, int]] = []
        for channel in self.clockwork.channels.values():
            for hit in channel.occurrences:
                if hit.what.isdecimal():
                    touched.add(int(hit.what))
                else:
                    spans.append((hit.at_ns - NS_PER_S, hit.at_ns + RECOVERY_NS))
        if spans:
            touched |= {
                exposure
                for exposure, truth in self.truth.items()
                if any(begin <= truth.ordered_ns <= end for begin, end in spans)
            }
        return touched
