"""A flood of refused commands neither fills the audit log nor hides what else is refused."""

from __future__ import annotations

import asyncio

import pytest

from daemon.onboard.monitoring.access import command_gateway as gate_module
from daemon.onboard.monitoring.access.command_gateway import CommandGateway, NotPermittedError
from daemon.onboard.monitoring.access.roles import Principal
from daemon.onboard.monitoring.web.refusal_limiter import (
    ADDRESSES_MAX,
    IN_TOTAL,
    PER_ADDRESS,
    RefusalLimiter,
)
from daemon.onboard.service.messages import CommandRefused

pytestmark = pytest.mark.trust
FLOOD = 10_000


def test_an_address_has_few_entries_and_the_others_are_counted() -> None:
    limiter = RefusalLimiter()
    recorded = sum(limiter.is_recorded("10.0.0.66", 1000.0) for _ in range(FLOOD))
    assert recorded == PER_ADDRESS
    assert limiter.is_recorded("10.0.0.9", 1000.0), "another address is not hidden by the flood"
    count, sentence = limiter.summary()
    assert count == FLOOD - PER_ADDRESS
    assert "10.0.0.66 (9995)" in sentence
    assert limiter.summary() == (0, "")
    assert limiter.is_recorded("10.0.0.66", 1031.0), "one more entry after half a minute"
    assert not limiter.is_recorded("10.0.0.66", 1031.0)


def test_many_addresses_share_a_total_and_memory_is_bounded() -> None:
    limiter = RefusalLimiter()
    recorded = sum(limiter.is_recorded(f"fd00::{i:x}", 1000.0) for i in range(FLOOD))
    assert recorded == IN_TOTAL
    assert len(limiter._addresses) <= ADDRESSES_MAX and len(limiter._counts) <= ADDRESSES_MAX
    count, sentence = limiter.summary()
    assert count == FLOOD - IN_TOTAL
    assert sentence.endswith("and others") and len(sentence) < 400
    assert limiter.is_recorded("10.0.0.9", 1006.0)


def test_the_gate_records_refusals_and_summarizes_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate_module, "SUMMARY_EVERY_S", 0.01)
    sent: list[object] = []

    async def flood() -> None:
        summarized = asyncio.Event()

        def send(message: object) -> None:
            sent.append(message)
            if isinstance(message, CommandRefused) and message.count > 1:
                summarized.set()

        gateway = CommandGateway(send)
        pilot = Principal("pilot", "observer", "10.0.0.9")
        for name in ("land", "../etc/passwd", *["stop"] * 50):
            with pytest.raises(NotPermittedError):
                await gateway.command(name, {}, pilot)
        await summarized.wait()

    asyncio.run(asyncio.wait_for(flood(), 30))
    refused = [one for one in sent if isinstance(one, CommandRefused)]
    assert len(refused) == len(sent) == PER_ADDRESS + 1
    assert [one.name for one in refused[:3]] == ["land", "unknown", "stop"]
    assert (refused[0].role, refused[0].address) == ("observer", "10.0.0.9")
    assert (refused[-1].name, refused[-1].count) == ("several", 52 - PER_ADDRESS)
