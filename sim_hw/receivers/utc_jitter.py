"""Errors of an emulated autopilot's UTC: jitter of each message, and steps."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from sim_hw.world.world_clock import NS_PER_S


@dataclass(frozen=True)
class UtcJitter:
    """How an autopilot's UTC errs against its own clock, message by message.

    Errors are to either side, their size is log-normal with that median and 95 % quantile; the
    defaults are those of a recorded ArduPilot. Every `step_every_s`, UTC is set by `step_ns` to
    either side and stays there.
    """

    median_ns: int = 2_000_000
    at_95_percent_ns: int = 24_000_000
    step_every_s: float = 0.0
    step_ns: int = 50_000_000
    seed: int = 0


class UtcErrors:
    """The errors of an autopilot's UTC as time goes on."""

    def __init__(self, jitter: UtcJitter | None) -> None:
        self._jitter = jitter
        self._random = random.Random(jitter.seed if jitter else 0)
        self._stepped_ns = 0
        self._step_at_ns: int | None = None

    def steps_ns(self, boot_ns: int) -> int:
        """By how much UTC was set until that time since start."""
        jitter = self._jitter
        if jitter is None or not jitter.step_every_s:
            return 0
        every_ns = round(jitter.step_every_s * NS_PER_S)
        if self._step_at_ns is None:
            self._step_at_ns = boot_ns + every_ns
        while boot_ns >= self._step_at_ns:
            self._step_at_ns += every_ns
            self._stepped_ns += self._random.choice((-1, 1)) * jitter.step_ns
        return self._stepped_ns

    def error_ns(self, boot_ns: int) -> int:
        """That of a message of that time since start: steps and jitter."""
        steps_ns, jitter = self.steps_ns(boot_ns), self._jitter
        if jitter is None:
            return steps_ns
        # 95 % of a normal variable lie below 1.645.
        spread = math.log(jitter.at_95_percent_ns / jitter.median_ns) / 1.645
        size = jitter.median_ns * math.exp(spread * self._random.gauss(0.0, 1.0))
        return steps_ns + round(self._random.choice((-1, 1)) * size)
