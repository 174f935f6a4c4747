"""Times of heads in the summary of an adjustment: delay, readout time and jitter, in ms."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any, Final

from daemon.terminal.console import Console, light_table
from processing.bundle.adjust import Adjustment
from processing.bundle.head_times import confounded_times, head_times

KINDS: Final = ("delay", "readout", "jitter")


def times_of(result: Adjustment) -> dict[str, Any]:
    """Times of the heads that have any, and sentences on what they are not separated from."""
    heads = []
    for one in head_times(result):
        values = asdict(one)
        name = values.pop("name")
        heads.append(
            {"name": name, **{f"{key[:-2]}_ms": value * 1e3 for key, value in values.items()}}
        )
    return {"heads": heads, "not_separated": list(confounded_times(result))}


def print_times(console: Console, times: Mapping[str, Any]) -> None:
    """The times as a table."""
    if times["heads"]:
        table = light_table("Times of heads, ms", ("",), ("delay", "readout time", "jitter"))
        for head in times["heads"]:
            table.add_row(head["name"], *(_cell(head, what) for what in KINDS))
        console.print(table)
    for sentence in times["not_separated"]:
        console.print(sentence, highlight=False)


def time_rows(times: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Rows of the protocol: head, delay, readout time, jitter with standard deviations."""
    for head in times["heads"]:
        yield (head["name"], *(_cell(head, what) for what in KINDS))


def _cell(head: Mapping[str, Any], what: str) -> str:
    value, sigma = head[f"{what}_ms"], head[f"{what}_sigma_ms"]
    if value is None or math.isnan(value):
        return "-"
    known = sigma is not None and not math.isnan(sigma)
    return f"{value:.4f}" + (f" ± {sigma:.4f}" if known else " held")
