"""One flight for all tests of this folder that only look at it."""

from __future__ import annotations

import pytest

from tests.system.flown import Flown, fly


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("first-flight"))
