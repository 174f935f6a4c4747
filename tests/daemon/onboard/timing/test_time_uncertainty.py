"""Timestamps say how good they are: 95 +- 2.5 % of errors lie inside two stated sigmas.

A thousand independent hosts, each with a crystal, interrupts and round trips of its own; see
`benchmarks.time_chain`, which prints the figures of docs/explanation/time.md.
"""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from benchmarks.time_chain import SETS, Errors, stamps
from benchmarks.time_truth import inside

RUNS = 1000


@pytest.fixture(scope="module")
def thousand() -> Mapping[str, Errors]:
    return stamps(RUNS)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", SETS)
def test_95_percent_of_a_thousand_independent_times_lie_inside_two_sigmas(
    thousand: Mapping[str, Errors], name: str
) -> None:
    errors_ns, sigmas_ns = thousand[name]
    assert len(errors_ns) == RUNS
    assert 0.925 <= inside(errors_ns, sigmas_ns, 2.0) <= 0.975
    assert inside(errors_ns, sigmas_ns, 4.0) >= 0.99
