"""A flight's writes, cut after every operation: recovery is right whatever a power cut took."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import mkdtemp

import pytest

from daemon.mission.store import durable
from tests.robustness.crash.prefixes import ACKS, Figures, cut, fly
from tests.robustness.crash.simulated_disk import (
    ALL_WRITTEN,
    DROPPED,
    TORN,
    VARIANTS,
    ZEROS,
    Disk,
    select_all,
)
from tests.robustness.crash.write_log import needs_strace

pytestmark = needs_strace

IN_CI = frozenset({ALL_WRITTEN, TORN, DROPPED, ZEROS})
MEMORY = Path("/dev/shm")


@pytest.fixture
def folder() -> Iterator[Path]:
    """On a disk in memory where there is one: some thousand states are put there and judged."""
    created = Path(mkdtemp(prefix="syntopic-", dir=MEMORY if MEMORY.is_dir() else None))
    yield created
    durable.remove_tree(created)


def summary(figures: Figures) -> str:
    return json.dumps(
        {
            "cuts": figures.cuts,
            "operations": figures.operations,
            "states": figures.states,
            "judged": sum(figures.checked.values()),
            "by variant": figures.checked,
            "exposures seen": figures.exposures,
            "set aside": figures.discarded,
            "wrong": len(figures.wrong),
        }
    )


def test_the_recorded_writes_make_the_same_disk_again(folder: Path) -> None:
    operations = fly(folder, 1)
    disk = Disk(folder)
    for operation in operations:
        disk.apply(operation)
    built = dict(disk.left(select_all, select_all))
    found = {
        str(path.relative_to(folder)): None if path.is_dir() else path.read_bytes()
        for path in folder.rglob("*")
        if "trace" not in path.parts and not path.name.endswith("-shm")
    }
    found.pop("trace", None)
    assert built == found and ACKS in built


def test_recovery_is_right_after_every_operation_of_a_flight(folder: Path) -> None:
    operations = fly(folder, 1)
    figures = cut(operations, folder, folder / "cut", names=IN_CI, random_ones=1, seed=1)
    print(summary(figures))
    assert figures.wrong == []
    assert figures.cuts == len(operations) > 250
    assert sum(figures.checked.values()) > 400 and figures.discarded > 0


@pytest.mark.parametrize("forgotten", ["folders", "frames", "log"])
def test_a_step_that_is_left_out_is_found(folder: Path, forgotten: str) -> None:
    operations = fly(folder, 1, forgotten)
    names = frozenset({DROPPED})
    assert cut(operations, folder, folder / "cut", names=names, max_wrong=1).wrong


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_recovery_is_right_after_every_operation_of_a_longer_flight(folder: Path) -> None:
    operations = fly(folder, 6)
    names = frozenset({*VARIANTS, TORN})
    figures = cut(operations, folder, folder / "cut", names=names, random_ones=6, seed=2)
    print(summary(figures))
    assert figures.wrong == []
