"""The tests of this folder run in the virtual machine only; elsewhere they say so."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if "KERNEL_GUEST" in os.environ:
        return
    mark = pytest.mark.skip(reason="runs in a virtual machine: make test-v4l2")
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(mark)
