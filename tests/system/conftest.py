"""One flight for all tests of this folder that only look at it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.demo_mission import DemoMission, fly


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> DemoMission:
    return fly(tmp_path_factory.mktemp("first-flight"))


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where emulators of one session keep the ground they have built, for those that fly over it
    again."""
    return tmp_path_factory.mktemp("scenes")
