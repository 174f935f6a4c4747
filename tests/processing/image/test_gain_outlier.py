"""Which PAN head is named where the overlaps differ, and which may be wrong instead."""

from __future__ import annotations

import math

import pytest

from processing.image.balance import Balance, GainOutlier, PairBalance

pytestmark = pytest.mark.trust

CHAIN = (("A", "B"), ("B", "C"), ("C", "D"), ("A", "C"), ("B", "D"))


def balance(logs: dict[str, float], off: dict[tuple[str, str], float] | None = None) -> Balance:
    """Overlaps of heads with these logarithms of signal, and gains that even them out."""
    pairs = tuple(
        PairBalance(a, b, logs[a] - logs[b] + (off or {}).get((a, b), 0.0), 1e-3, 500)
        for a, b in CHAIN
        if a in logs and b in logs
    )
    mean = sum(logs.values()) / len(logs)
    return Balance({name: math.exp(mean - value) for name, value in logs.items()}, pairs)


@pytest.mark.parametrize("name", "ABCD")
@pytest.mark.parametrize("signal", [0.5, 1.2])
def test_a_head_that_is_off_in_all_of_its_overlaps_is_named_alone(name: str, signal: float) -> None:
    logs = {**dict.fromkeys("ABCD", 0.0), name: math.log(signal)}
    assert balance(logs).outlier_without(()) == GainOutlier(name, pytest.approx(signal))


def test_of_two_heads_either_may_be_wrong() -> None:
    found = balance({"A": math.log(0.5), "B": 0.0}).outlier_without(())
    assert found is not None
    assert {found.sensor, *found.alternatives} == {"A", "B"}


def test_where_one_overlap_differs_and_the_others_do_not_both_of_its_heads_are_named() -> None:
    gains = {"A": 0.88, "B": 1.0, "C": 1.13, "D": 1.0}
    pairs = balance(dict.fromkeys("ABCD", 0.0), {("A", "C"): 0.4}).pairs
    found = Balance(gains, pairs).outlier_without(())
    assert found is not None
    assert {found.sensor, *found.alternatives} == {"A", "C"}


def test_a_head_whose_signal_changes_within_its_frame_does_not_count() -> None:
    logs = {**dict.fromkeys("ABCD", 0.0), "D": math.log(1.4)}
    assert balance(logs).outlier_without({"D"}) is None
    assert balance(dict.fromkeys("ABCD", 0.07)).outlier_without(()) is None
