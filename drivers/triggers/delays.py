"""The delays that a trigger accepts."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from drivers.contract import DeviceError

MAX_DELAY_NS: Final = 1_000_000_000


def check_delays(name: str, delays_ns: Mapping[str, int], outputs: Collection[str]) -> None:
    """Refuse delays that a trigger cannot give.

    Args:
        name: name of the trigger, for the message.
        delays_ns: delay from firing by output, ns; 0 to MAX_DELAY_NS.
        outputs: outputs that the trigger has.

    Raises:
        DeviceError: an output does not exist or a delay is out of range; with all errors.
    """
    wrong = [
        f"output {output!r} does not exist; the trigger has {', '.join(outputs)}"
        for output in delays_ns
        if output not in outputs
    ]
    wrong += [
        f"delay of output {output!r} is {delay_ns} ns; 0 to {MAX_DELAY_NS}"
        for output, delay_ns in delays_ns.items()
        if not 0 <= delay_ns <= MAX_DELAY_NS
    ]
    if wrong:
        raise DeviceError("\n".join(f"{name}: {sentence}" for sentence in wrong))
