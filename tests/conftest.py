"""What holds for all tests: patience on a busy machine, and the right of way for whole flights.

Under pytest-xdist whole flights (tests/system) run first and one after another in one worker, at
normal priority since they run in real time; everything else runs file by file in parallel, at a
lower one, the pages of the documents first since they take longest.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests.support.skips import pytest_addoption, pytest_sessionfinish, pytest_terminal_summary
from tests.support.stopwatch import slowdown

__all__ = ["pytest_addoption", "pytest_sessionfinish", "pytest_terminal_summary"]

FLIGHTS = Path(__file__).parent / "system"
TOGETHER = (
    "tests/system",
    "tests/daemon/onboard/triangulation",
    "tests/daemon/postflight/gis",
    "tests/daemon/postflight/orthomosaic",
)
"""Folders whose `conftest.py` flies a mission for all their files: one worker runs each."""
PAGES = Path(__file__).parent / "repository" / "test_document_examples.py"
# Where other programs keep all cores busy, less than their priority would be a standstill.
NICENESS = int(os.environ.get("SYNTOPIC_TEST_NICENESS", "10"))

# A command in this process would set it for itself, and the threads of all later tests with it.
os.environ.setdefault("NUMBA_NUM_THREADS", str(len(os.sched_getaffinity(0))))

settings.register_profile("patient", settings.default, deadline=None)
settings.load_profile("patient")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """File by file, but folders that share what takes long to build as if they were one file."""
    from xdist.scheduler import LoadFileScheduling

    class FlightsFirstScheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            folder = next((one for one in TOGETHER if nodeid.startswith(f"{one}/")), None)
            return folder or super()._split_scope(nodeid)

    return FlightsFirstScheduling(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, None, None]:
    """What is collected stays: no search for cycles visits it, during the collection or later."""
    gc.disable()
    yield
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The longest first; time-outs against hanging grow with the load of the machine."""
    items.sort(key=lambda item: (not _is_flight(item), item.path != PAGES))
    factor = slowdown()
    for item in items:
        if _is_flight(item):
            item.add_marker(pytest.mark.realtime)
        marked = item.get_closest_marker("timeout")
        timeout_s = marked.args[0] if marked else config.getoption("timeout")
        if timeout_s:
            item.add_marker(pytest.mark.timeout(timeout_s * factor), append=False)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """What is no flight steps back, for good."""
    if "PYTEST_XDIST_WORKER" in os.environ and not _is_flight(item):
        os.nice(NICENESS - os.nice(0))


def _is_flight(item: pytest.Item) -> bool:
    return FLIGHTS in item.path.parents
