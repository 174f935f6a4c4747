"""Cuts a recorded flight after every operation and judges what recovery makes of every state."""

from __future__ import annotations

import hashlib
import random
import sys
import traceback
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from daemon.mission.store import durable
from tests.robustness.crash.invariants import Acknowledged, check_invariants
from tests.robustness.crash.simulated_disk import (
    TORN,
    VARIANTS,
    Disk,
    Tree,
    at_random,
    put,
    variants,
)
from tests.robustness.crash.write_log import Operation, record

ROOT = Path(__file__).parents[3]
ACKS = "acks"
FLOWN = "root"


@dataclass
class Figures:
    """What was cut, and what was found."""

    operations: Counter[str] = field(default_factory=Counter)
    cuts: int = 0
    states: int = 0
    checked: Counter[str] = field(default_factory=Counter)
    exposures: int = 0
    discarded: int = 0
    wrong: list[str] = field(default_factory=list)


def fly(folder: Path, exposures: int, forgets: str = "nothing") -> list[Operation]:
    """Record a flight of two lives of so many exposures each, below `folder`."""
    program = [sys.executable, "-m", "tests.robustness.crash.scripted_flight"]
    arguments = [str(folder / FLOWN), str(folder / ACKS), str(exposures), forgets]
    return record([*program, *arguments], folder, folder / "trace", cwd=ROOT)


def cut(
    operations: list[Operation],
    folder: Path,
    scratch: Path,
    *,
    names: frozenset[str] = frozenset(VARIANTS),
    random_ones: int = 0,
    seed: int = 0,
    max_wrong: int = 5,
) -> Figures:
    """Judge every state after every operation; the same state after the same words only once.

    Args:
        operations: as `fly` returned them.
        folder: where that flight was flown.
        scratch: a folder that is not there, on a fast disk; it is made and removed each time.
        names: which of `VARIANTS` are tried.
        random_ones: how many arbitrary sets of survivors are tried at each cut besides.
        seed: of those.
        max_wrong: after so many findings no more are looked for.
    """
    figures = Figures()
    disk = Disk(folder)
    acknowledged = Acknowledged()
    acknowledgements = ""
    seen: set[bytes] = set()
    for index, operation in enumerate(operations):
        states: list[tuple[str, Tree]] = []
        if operation.path == str(folder / ACKS):
            for line in operation.data.decode().splitlines():
                acknowledged.add_line(line)
                acknowledgements += f"{line}\n"
        else:
            figures.operations[operation.kind] += 1
            if operation.kind == "write" and TORN in names:
                states.append((TORN, disk.torn(operation)))
            disk.apply(operation)
        figures.cuts += 1
        states += variants(disk, names)
        states += at_random(disk, random.Random(f"{seed}-{index}"), random_ones)
        for name, tree in states:
            figures.states += 1
            key = key_of(tree, acknowledgements)
            if key in seen:
                continue
            seen.add(key)
            figures.checked[name] += 1
            try:
                _check_state(tree, acknowledged, scratch, figures, flies_on=len(seen) % 4 == 0)
            except Exception as error:  # noqa: BLE001 - whatever recovery raises is a finding
                where = f"after {index} ({operation.kind} {Path(operation.path).name}), {name}"
                at = traceback.extract_tb(error.__traceback__)[-1]
                figures.wrong.append(
                    f"{where}: {type(error).__name__}: {error} ({at.name}, line {at.lineno})"
                )
                if len(figures.wrong) >= max_wrong:
                    return figures
    return figures


def _check_state(
    tree: Tree, acknowledged: Acknowledged, scratch: Path, figures: Figures, *, flies_on: bool
) -> None:
    put(tree, scratch)
    try:
        outcome = check_invariants(scratch / FLOWN, acknowledged, flies_on=flies_on)
    finally:
        with suppress(OSError):
            durable.remove_tree(scratch)
    figures.exposures += outcome.exposures
    figures.discarded += outcome.discarded


def key_of(tree: Tree, acknowledgements: str = "") -> bytes:
    """Two states with the same key need to be judged only once."""
    digest = hashlib.sha256(acknowledgements.encode())
    for path, data in sorted(tree.items()):
        digest.update(f"{path}\0{-1 if data is None else len(data)}\0".encode())
        digest.update(data or b"")
    return digest.digest()
