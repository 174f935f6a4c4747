"""A transfer that removes its source, killed or cut off from power anywhere, keeps a whole copy."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import mkdtemp

import pytest

from daemon.mission.store import durable
from tests.robustness.crash.kill_transfer import BEGUN, FLOWN, OTHER_DISK, TransferCase, content_of
from tests.robustness.crash.prefixes import ROOT, key_of
from tests.robustness.crash.simulated_disk import (
    ALL_WRITTEN,
    DROPPED,
    VARIANTS,
    ZEROS,
    Disk,
    at_random,
    put,
    variants,
)
from tests.robustness.crash.test_prefixes import MEMORY
from tests.robustness.crash.write_log import Operation, needs_strace, record

PAIRS = int(os.environ.get("SYNTOPIC_TRANSFER_PAIRS", "1000"))
"""Rounds of two kills in the long run."""


@pytest.fixture
def folder() -> Iterator[Path]:
    created = Path(mkdtemp(prefix="syntopic-", dir=MEMORY if MEMORY.is_dir() else None))
    yield created
    durable.remove_tree(created)


def killed(folder: Path, what: str) -> dict[str, object]:
    command = [sys.executable, "-m", "tests.robustness.crash.kill_transfer", str(folder), what]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=3000)
    assert done.returncode == 0, done.stderr[-3000:]
    figures: dict[str, object] = json.loads(done.stdout)
    print(json.dumps(figures))
    return figures


@pytest.mark.trust
def test_a_kill_at_every_call_of_a_transfer_leaves_a_complete_copy(folder: Path) -> None:
    figures = killed(folder, "every")
    assert figures["wrong"] == []
    assert isinstance(figures["calls"], int) and figures["calls"] > 200
    assert isinstance(figures["kills"], int) and figures["kills"] > figures["calls"]


@pytest.mark.trust
def test_two_kills_in_a_row_leave_a_complete_copy(folder: Path) -> None:
    figures = killed(folder, "pairs:100:1")
    assert figures["wrong"] == [] and figures["kills"] == 200


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_many_pairs_of_kills_leave_a_complete_copy(folder: Path) -> None:
    figures = killed(folder, f"pairs:{PAIRS}:2")
    assert figures["wrong"] == [] and figures["kills"] == 2 * PAIRS


def cut(
    operations: list[Operation], folder: Path, names: frozenset[str], *, max_wrong: int, seed: int
) -> tuple[int, list[str]]:
    """Judge what power cuts after every operation leave; the number of states, and findings."""
    copy = next((folder / OTHER_DISK).iterdir())
    case = TransferCase(folder / FLOWN / copy.name, folder / OTHER_DISK, content_of(copy))
    disk = Disk(folder)
    rng = random.Random(seed)
    seen: set[bytes] = set()
    wrong: list[str] = []
    has_begun = False
    for operation in operations:
        if operation.path == str(folder / BEGUN):
            has_begun = True
            continue
        disk.apply(operation)
        if not has_begun:
            continue
        for name, tree in [*variants(disk, names), *at_random(disk, rng, 1)]:
            if (key := key_of(tree)) in seen:
                continue
            seen.add(key)
            scratch = folder / "cut"
            put(tree, scratch)
            try:
                case.moved_to(scratch).check_interrupted(reruns=len(seen) % 3 == 0)
            except Exception as error:  # noqa: BLE001 - whatever a rerun raises is a finding
                wrong.append(f"{operation.kind} {operation.path}, {name}: {error}")
                if len(wrong) == max_wrong:
                    return len(seen), wrong
            finally:
                durable.remove_tree(scratch)
    return len(seen), wrong


def recorded(folder: Path, forgets: str = "nothing") -> list[Operation]:
    command = [
        sys.executable,
        "-m",
        "tests.robustness.crash.kill_transfer",
        str(folder),
        f"once:{forgets}",
    ]
    return record(command, folder, folder / "trace", cwd=ROOT)


@pytest.mark.trust
@needs_strace
def test_power_loss_after_every_call_of_a_transfer_leaves_a_complete_copy(folder: Path) -> None:
    names = frozenset({DROPPED, ZEROS})
    states, wrong = cut(recorded(folder), folder, names, max_wrong=5, seed=1)
    assert wrong == []
    assert states > 150


@needs_strace
@pytest.mark.parametrize("forgotten", ["files", "folders"])
def test_a_sync_that_a_transfer_leaves_out_is_found(folder: Path, forgotten: str) -> None:
    operations = recorded(folder, forgotten)
    assert cut(operations, folder, frozenset({DROPPED}), max_wrong=1, seed=1)[1]


@pytest.mark.soak
@needs_strace
@pytest.mark.timeout(3600)
def test_power_loss_in_a_transfer_in_all_variants(folder: Path) -> None:
    names = frozenset({ALL_WRITTEN, *VARIANTS})
    states, wrong = cut(recorded(folder), folder, names, max_wrong=5, seed=2)
    print(states)
    assert wrong == []
