"""A walk over exposures goes on after one that fails, and ends where the disk is closed."""

from __future__ import annotations

import errno
import os

import pytest

from daemon.mission.exposure_batch import for_each_exposure


@pytest.mark.trust
def test_a_full_disk_ends_the_walk_and_names_every_exposure_not_attempted() -> None:
    visited = []

    def action(number: int) -> int:
        visited.append(number)
        if number == 2:
            raise KeyError("LEFT")
        if number == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return number

    done = for_each_exposure([1, 2, 3, 4, 5], action)
    assert visited == [1, 2, 3] and dict(done.results) == {1: 1}
    assert [failure.exposure for failure in done.failures] == [2, 3, 4, 5]
    assert done.failures[0].cause == "KeyError: 'LEFT'"
    assert done.failures[3].cause.startswith("not attempted, because of exposure 3: No space")
