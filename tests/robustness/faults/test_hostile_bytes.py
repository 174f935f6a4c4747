"""Parsers under random and mutated messages: nothing raises, nothing grows, all find back.

One million mutated messages over all parsers here, ten million in `make soak`. They come in
batches: hypothesis chooses how a batch is spoilt and cut, and finds its smallest again.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.robustness.faults.hostile_parsers import PARSERS, Mutator, Parser
from tests.robustness.faults.retained_memory import retained_nbytes

MESSAGES = 1_000_000
SOAK_MESSAGES = 10_000_000
BATCH = 1000
GROUP = 20
FOLLOWING = 3
"""So many spoilt messages, then one genuine that may be lost, then so many that may not."""
PIECE_NBYTES = (1, 4096)
GROWTH_NBYTES = 60_000

pytestmark = pytest.mark.timeout(1200)


def pieces(data: bytes, rng: random.Random) -> Iterator[bytes]:
    """As it may arrive: cut anywhere."""
    at = 0
    while at < len(data):
        size = rng.randint(*PIECE_NBYTES)
        yield data[at : at + size]
        at += size


def survive(parser: Parser, seed: int, count: int) -> None:
    """Feed a batch of spoilt messages with genuine ones between, which are to be understood."""
    rng = random.Random(seed)
    spoilt = Mutator(parser.genuine, parser.reseal, rng).messages(count)
    if parser.answers_only:
        for message in spoilt:
            parser.feed(message)
        before = parser.understood()
        parser.feed(parser.genuine[0])
        assert parser.understood() == before + 1, "a good answer after bad ones is taken"
        return
    genuine = parser.genuine
    for _ in range(count // GROUP):
        data = b"".join(next(spoilt) for _ in range(GROUP))
        for piece in pieces(data, rng):
            parser.feed(piece)
        # The first may fall victim to what the last damaged message promised; no other may.
        first = rng.randrange(len(genuine))
        parser.feed(genuine[first])
        before = parser.understood()
        for number in range(1, FOLLOWING + 1):
            parser.feed(genuine[(first + number) % len(genuine)])
        understood = parser.understood() - before
        assert understood >= FOLLOWING, f"{understood} of {FOLLOWING} after one after damage"


def examples(parser: Parser, total: int) -> int:
    return max(1, round(parser.share * total / BATCH))


def run(name: str, total: int) -> None:
    if name == "mavlink":
        pytest.importorskip("pymavlink", reason="pymavlink is absent; pip install it")
    parser = PARSERS[name]()
    survive(parser, 0, BATCH)
    retained = retained_nbytes(parser.state)
    seeds = iter(range(1, 1 << 60))

    @settings(
        max_examples=examples(parser, total),
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.integers(0, 2**63))
    def batches(seed: int) -> None:
        survive(parser, seed ^ next(seeds), BATCH)

    batches()
    assert retained_nbytes(parser.state) < retained + GROWTH_NBYTES, (
        "what a parser keeps is bounded"
    )


def test_the_shares_of_all_parsers_are_the_whole() -> None:
    assert sum(make().share for name, make in PARSERS.items() if name != "mavlink") <= 1.0 + 1e-9


@pytest.mark.parametrize("name", list(PARSERS))
def test_mutated_messages_do_no_harm(name: str) -> None:
    run(name, int(os.environ.get("SYNTOPIC_HOSTILE_MESSAGES", MESSAGES)))


@pytest.mark.soak
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("name", list(PARSERS))
def test_ten_million_mutated_messages_do_no_harm(name: str) -> None:
    run(name, SOAK_MESSAGES)
