"""Committed products of a mission folder checked against their manifests, every byte.

Products without a manifest are of a computation that was stopped, or of the flight; they are listed
as not covered.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from daemon.mission.layout import Mission, is_exposure_name
from daemon.mission.store.product_manifests import (
    MANIFESTS,
    committed_keys,
    product_problems,
    read_manifest,
)
from daemon.mission.verification.inventory import Inventory


@dataclass(frozen=True)
class CheckedProducts:
    """Paths in the mission of the files that were compared, and a sentence for every problem."""

    files: tuple[str, ...]
    problems: tuple[str, ...]


def check_products(
    mission: Mission, inventory: Inventory, step: Callable[[int], None]
) -> CheckedProducts:
    """Compare the files of every committed key with its manifest.

    Args:
        mission: it may be processed at the same time.
        inventory: of its folder.
        step: called with the number of bytes read.
    """
    root = mission.level2_root.name
    numbers = [
        int(name) for name in inventory.below(f"{MANIFESTS}/{root}") if is_exposure_name(name)
    ]

    def check(number: int) -> tuple[list[str], list[str]]:
        files: list[str] = []
        problems: list[str] = []
        for key in committed_keys(mission, number):
            manifest = read_manifest(mission, number, key)
            found = product_problems(mission, number, key, step)
            if found and key not in committed_keys(mission, number):
                continue  # another process replaces the products; it commits them when written
            problems += [f"{one}; {_remedy(number)}" for one in found]
            if manifest is not None:
                folder = f"{root}/{mission.level2(number).name}"
                files += [f"{folder}/{name}" for name in manifest.files]
        return files, problems

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        checked = list(pool.map(check, numbers))
    return CheckedProducts(
        tuple(file for files, _ in checked for file in files),
        tuple(problem for _, problems in checked for problem in problems),
    )


def _remedy(number: int) -> str:
    return f"compute it again: syntopic process MISSION --again --only {number}"
