"""A rendered block that several tests look at: two lines of five exposures; do not change it."""

from __future__ import annotations

import pytest

from tests.daemon.flown_block import FlownBlock, flown_block

EACH, LINES = 5, 2


@pytest.fixture(scope="session")
def flown(tmp_path_factory) -> FlownBlock:
    """The mission and its truth."""
    return flown_block(tmp_path_factory.mktemp("flown"), EACH, LINES)
