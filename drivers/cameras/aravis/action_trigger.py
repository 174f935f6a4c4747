"""GigE Vision action commands to all heads: immediate, or scheduled on each head's own clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from drivers.base.settings import Setting
from drivers.cameras.aravis.aravis_head import AravisHead
from drivers.contract import DeviceError, Head
from drivers.timescales.clock import Clock
from drivers.triggers.software import SoftwareTrigger


class ActionTrigger(SoftwareTrigger):
    """Fires every head by an action command of its own, so that each acknowledges it.

    With `scheduled`, the commands are sent ahead of time and contain the instant on the head's
    clock, computed from its last latch. No precision time protocol is needed, and the remaining
    jitter is the sigma of the latch. Otherwise each head exposes when it receives its command.

    Source: GigE Vision 2.0, section 14.5.
    """

    kind: ClassVar = "trigger"
    head_trigger_source: ClassVar = "action"

    scheduled = Setting(
        True, help="send the time of exposure on the head's clock, not an immediate command"
    )
    lead_ms = Setting(50.0, minimum=1, maximum=1000, help="how long ahead commands are sent")

    def __init__(
        self,
        name: str,
        settings: Mapping[str, object],
        *,
        heads: Mapping[str, Sequence[Head]],
        clock: Clock | None = None,
    ) -> None:
        unfit = [
            f"{name}: the head {head.name} waits for no action command; give it the driver aravis "
            'and trigger_source = "action"'
            for group in heads.values()
            for head in group
            if not isinstance(head, AravisHead) or head.trigger_source != "action"
        ]
        if unfit:
            raise DeviceError("\n".join(unfit))
        super().__init__(name, settings, heads=heads, clock=clock)

    def bind(self) -> Mapping[str, str]:
        """The outputs, heads and mode. See `drivers.contract.Trigger`."""
        return {**super().bind(), "actions": "scheduled" if self.scheduled else "immediate"}

    def _fire_one(self, head: Head, delay_ns: int, start_ns: int) -> tuple[int, int]:
        if not self.scheduled:
            return super()._fire_one(head, delay_ns, start_ns)
        assert isinstance(head, AravisHead)
        moment_ns = start_ns + round(self.lead_ms * 1e6)
        head_clock = head.clock_at(moment_ns + delay_ns)
        if head_clock is None:
            raise DeviceError(
                f"{head.name}: the head's clock is unknown; set scheduled = false, or use a "
                "head with a timestamp latch"
            )
        device_ns, sigma_ns = head_clock
        head.send_action_command(device_ns)
        return moment_ns - sigma_ns, moment_ns + sigma_ns
