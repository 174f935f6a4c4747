"""No verification of a mission that is being flown raises a false alarm."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.robustness.crash.verified_flight import verify_in_flight


@pytest.mark.trust
def test_verification_in_flight_raises_no_false_alarm(tmp_path: Path) -> None:
    verified = verify_in_flight(tmp_path, 40, 1)
    assert verified.problems == []
    assert verified.states["flown"] > 10


@pytest.mark.soak
def test_thousands_of_verifications_in_flight_raise_no_false_alarm(tmp_path: Path) -> None:
    verified = verify_in_flight(tmp_path, int(os.environ.get("SYNTOPIC_VERIFICATIONS", "2000")), 2)
    assert verified.problems == []
    assert verified.states["flown"] > 1000
