"""The chain over exposure records: each quotes the hash of the one sealed before it.

Pure functions: from hashes they find where the chain is broken. An altered, removed or inserted
record is detected; the last record needs the index.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class ChainLink:
    """A sealed record: the hash of its bytes, and the hash it quotes."""

    number: int
    sha256: str
    previous_sha256: str


@dataclass(frozen=True)
class ChainReport:
    """Records in the order they were sealed, as far as the chain reaches; unreachable ones last.

    `head_sha256` is what the next record quotes: the hash of the last record reached, or the
    genesis where there is none.
    """

    order: tuple[ChainLink, ...]
    head_sha256: str
    problems: tuple[str, ...]


def follow_chain(links: Iterable[ChainLink], genesis_sha256: str) -> ChainReport:
    """Follow the chain from its beginning.

    Args:
        links: the records, in any order.
        genesis_sha256: what the first record quotes.
    """
    records = sorted(links, key=lambda link: link.number)
    following: dict[str, list[ChainLink]] = {}
    for link in records:
        following.setdefault(link.previous_sha256, []).append(link)
    problems = [
        f"exposures {', '.join(str(b.number) for b in branch)} quote the same record before them; "
        "one of them was slipped in or the index was lost while flying"
        for branch in following.values()
        if len(branch) > 1
    ]
    known = {genesis_sha256, *(link.sha256 for link in records)}
    problems += [
        f"the chain is broken before exposure {link.number}: it quotes "
        f"{link.previous_sha256[:12] or 'nothing'}, which no record has; "
        "a record was altered or removed"
        for link in records
        if link.previous_sha256 not in known
    ]
    order = _reachable(genesis_sha256, following)
    # Behind a break the chain goes on: what was sealed after it is still in order.
    seen = {link.number for link in order}
    for link in records:
        if link.number not in seen and link.previous_sha256 not in known:
            unreachable = [link, *_reachable(link.sha256, following)]
            order += [b for b in unreachable if b.number not in seen]
            seen.update(b.number for b in unreachable)
    order += [link for link in records if link.number not in seen]
    head = order[-1].sha256 if order else genesis_sha256
    return ChainReport(tuple(order), head, tuple(problems))


def _reachable(start_sha256: str, following: dict[str, list[ChainLink]]) -> list[ChainLink]:
    order: list[ChainLink] = []
    waiting = [start_sha256]
    visited: set[str] = set()
    while waiting:
        sha256 = waiting.pop(0)
        if sha256 in visited:
            continue
        visited.add(sha256)
        for link in following.get(sha256, ()):
            order.append(link)
            waiting.append(link.sha256)
    return order
