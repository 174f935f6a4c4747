"""What holds for all tests: patience on a busy machine, and the right of way for whole flights.

Under pytest-xdist whole flights (tests/system) come first and one after another in one worker, at
normal priority since they run in real time; everything else runs file by file beside them, at the
lowest.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

FLIGHTS = Path(__file__).parent / "system"
LOWEST = 19

settings.register_profile("patient", settings.default, deadline=None)
settings.load_profile("patient")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Flights first; what has to stay in one worker is told apart for `--dist loadgroup`."""
    items.sort(key=lambda item: not _is_flight(item))
    for item in items:
        group = "flights" if _is_flight(item) else item.nodeid.split("::")[0]
        item.add_marker(pytest.mark.xdist_group(group))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """What is no flight steps back, for good."""
    if "PYTEST_XDIST_WORKER" in os.environ and not _is_flight(item):
        os.nice(LOWEST - os.nice(0))


def _is_flight(item: pytest.Item) -> bool:
    return FLIGHTS in item.path.parents
