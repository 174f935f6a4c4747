"""Is what a mission folder holds still what was stored: hashes, chain, index, logs.

Reads only. Everything is compared with a hash, or listed as not covered with the reason. While
the mission is flown, index, chain file and disk are read in this order, the reverse of the order in
which they are written: what an earlier one names must be in each later one, whatever is added
meanwhile, so nothing has to be waited for or checked twice. Repairing is in
`daemon.mission.verification.recovery`.
"""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from daemon.mission.canonical_json import RecordError
from daemon.mission.catalog.catalog import Catalog, CatalogError, IndexedExposure
from daemon.mission.layout import DISCARDED, Mission, is_exposure_name
from daemon.mission.log.log_seals import CHANGING_FILES, SEALS_FILE, read_seals
from daemon.mission.store.level0_folder import hash_file
from daemon.mission.store.product_manifests import MANIFESTS
from daemon.mission.verification.chain import ChainLink, follow_chain
from daemon.mission.verification.chain_file import CHAIN_FILE, History, LogSeal, read_history
from daemon.mission.verification.inventory import (
    UNFINISHED,
    UncoveredFiles,
    group,
    is_unfinished,
    reasons_for,
    take_inventory,
)
from daemon.mission.verification.verified_exposure import (
    ExpectedExposure,
    FoundExposure,
    check_exposure,
)
from daemon.mission.verification.verified_products import check_products

Progress = Callable[[int, int], None]
CheckAll = Callable[[Sequence[ExpectedExposure], Callable[[int], None]], list[FoundExposure]]

STATES = {
    "flown": "being flown, or its service was killed and it was not continued yet",
    "ended": "the flight has ended",
    "by hand": "laid out by hand: no chain of records",
}


@dataclass(frozen=True)
class CoveredFiles:
    """Files of one kind that were compared with a hash, and where that hash is written."""

    what: str
    files: int
    by: str


@dataclass(frozen=True)
class VerifyReport:
    """Result of a verification: checked parts, skipped parts, and one message for every problem.

    `state` is a key of `STATES`; `remarks` are limits of what could be noticed.
    """

    exposures: int
    frames: int
    nbytes: int
    problems: tuple[str, ...]
    state: str = "ended"
    covered: tuple[CoveredFiles, ...] = ()
    not_covered: tuple[UncoveredFiles, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def is_intact(self) -> bool:
        return not self.problems


def check_in_threads(
    expected: Sequence[ExpectedExposure], step: Callable[[int], None]
) -> list[FoundExposure]:
    """Compare exposures in this process.

    Args:
        expected: of each exposure.
        step: called with the number of bytes read.
    """
    # Hashing lets go of the interpreter, so that threads are enough to use every core.
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        return list(pool.map(lambda one: check_exposure(one, step), expected))


def verify(
    mission: Mission,
    progress: Progress = lambda done, total: None,
    check_all: CheckAll = check_in_threads,
) -> VerifyReport:
    """Check everything in a mission folder.

    A mission laid out by hand has no index and no chain; there only hashes that are given count.

    Args:
        mission: it may be flown at the same time.
        progress: called with bytes done and bytes in total.
        check_all: compares exposures, in this process or elsewhere.
    """
    return _Verification(mission, progress, check_all).run()


class _Verification:
    def __init__(self, mission: Mission, progress: Progress, check_all: CheckAll) -> None:
        self.mission, self._check_all = mission, check_all
        self.problems: list[str] = []
        self.remarks: list[str] = []
        self.not_covered: dict[str, str] = {}
        self.covered: dict[tuple[str, str], int] = {}
        self._progress = progress
        self._done = 0
        self._total = 0
        self._counting = threading.Lock()
        # The order of these four is what makes a verification in flight free of false alarms.
        self.is_flown = mission.is_current
        self.index, self.index_error = _read_index(mission, is_flown=self.is_flown)
        self.history = self._read_history()
        self.inventory = take_inventory(mission.path)
        self.left = dict(self.inventory.files)

    def run(self) -> VerifyReport:
        numbers = self._numbers()
        self._total = sum(
            size for path, size in self.left.items() if path.endswith((".tif", ".mcap"))
        )
        genesis = self._mission_files()
        exposures = self._exposures(numbers, is_chained=bool(genesis))
        self._products()
        self._logs(is_flown_mission=bool(genesis))
        if genesis:
            self._records(exposures, genesis)
            self._index(exposures)
            self._closing()
        self._entries()
        self.not_covered |= reasons_for(self.left)
        present = [found for found in exposures.values() if found.is_there]
        return VerifyReport(
            exposures=len(present),
            frames=sum(len(found.frames) for found in present),
            nbytes=self._done,
            problems=tuple(self.problems),
            state="by hand" if not genesis else "flown" if self.is_flown else "ended",
            covered=tuple(CoveredFiles(what, n, by) for (what, by), n in self.covered.items()),
            not_covered=group(self.not_covered),
            remarks=tuple(self.remarks),
        )

    def step(self, count: int) -> None:
        """Bytes were read."""
        with self._counting:
            self._done += count
            self._progress(self._done, max(self._total, self._done))

    def _cover(self, what: str, by: str, *paths: str) -> None:
        self.covered[what, by] = self.covered.get((what, by), 0) + len(paths)
        for path in paths:
            self.left.pop(path, None)

    def _read_history(self) -> History:
        try:
            return read_history(self.mission.chain_path)
        except OSError as error:
            self.problems.append(f"{CHAIN_FILE}: cannot be read ({error.strerror})")
            return History()

    def _numbers(self) -> list[int]:
        """Exposures on disk, in the chain file or in the index."""
        folders = (path[3:] for path in self.inventory.folders if path.startswith("L0/"))
        there = {int(name) for name in folders if is_exposure_name(name)}
        return sorted(there | self.history.numbers | self.index.keys())

    def _mission_files(self) -> str:
        """mission.json, the chain file and what was configured; returns where the chain begins."""
        about, genesis = self.mission.about(), self.mission.genesis_sha256()
        if not genesis:
            if not self.history.exists and not self.index:
                why = "mission laid out by hand: no mission.json has a hash of it"
                configured = [p for p in ("rig.toml", "service.toml") if self.left.pop(p, None)]
                self.not_covered |= dict.fromkeys(configured, why)
                return ""
            self.problems.append("mission.json: is missing; the chain of records begins with it")
        if self.history.exists:
            self._chain_file()
            if genesis and self.history.genesis_sha256 not in ("", genesis):
                self.problems.append("mission.json: was altered since the flight began")
            self._cover("mission.json", CHAIN_FILE, *(["mission.json"] if genesis else []))
            genesis = self.history.genesis_sha256 or genesis
        elif genesis and about.get("format") != 1:
            self.problems.append(
                f"{CHAIN_FILE}: is missing; without it the removal of the newest exposures cannot "
                "be noticed (syntopic repair writes it again)"
            )
            self._cover("mission.json", "the first record", "mission.json")
        elif genesis:
            self._cover("mission.json", "the first record", "mission.json")
            self.remarks.append(
                "format 1: the removal of the newest exposures cannot be noticed once the index "
                "was built again"
            )
        self._configured(about)
        return genesis or "0" * 64

    def _chain_file(self) -> None:
        self.problems += self.history.problems
        self._cover("chain of files", "each line's own hash", CHAIN_FILE)
        if self.history.rebuilt_utc:
            self.problems.append(
                f"{CHAIN_FILE}: was missing and was written again at {self.history.rebuilt_utc}; "
                "what was removed before cannot be noticed"
            )
        if self.history.torn_nbytes and not self.is_flown:
            self.problems.append(
                f"{CHAIN_FILE}: its last line is not whole; it was truncated, or the service was "
                "killed (syntopic repair)"
            )

    def _configured(self, about: dict[str, object]) -> None:
        expected = {"rig.toml": about.get("rig_sha256")}
        expected["service.toml"] = about.get("service_sha256")
        plan = about.get("plan")
        if isinstance(plan, dict):
            expected[str(plan.get("file"))] = plan.get("sha256")
        for name, sha256 in expected.items():
            if isinstance(sha256, str):
                self._check_file(name, sha256, "mission.json")
        if about.get("format") == 1 and (flown_plan := self.mission.plan_path) is not None:
            del self.left[flown_plan.name]
            self.not_covered[flown_plan.name] = "flight plan of format 1, without a hash"

    def _check_file(self, name: str, expected: str, by: str) -> None:
        self._cover(name, by, name)
        try:
            if name not in self.inventory.files:
                self.problems.append(f"{name}: is missing")
            elif hash_file(self.mission.path / name) != expected:
                self.problems.append(f"{name}: was altered; its hash differs from that in {by}")
        except OSError as error:
            self.problems.append(f"{name}: cannot be read ({error.strerror})")

    def _exposures(self, numbers: list[int], *, is_chained: bool) -> dict[int, FoundExposure]:
        folders = set(self.inventory.folders)
        special_files: dict[str, list[str]] = {}
        for path in self.inventory.special_files:
            folder, _, name = path.rpartition("/")
            special_files.setdefault(folder, []).append(name)
        expected = [
            ExpectedExposure(
                number=number,
                folder=self.mission.level0(number),
                names=self.inventory.below(f"L0/{self.mission.level0(number).name}"),
                is_there=f"L0/{self.mission.level0(number).name}" in folders,
                special_files=special_files.get(f"L0/{self.mission.level0(number).name}", []),
                capture_sha256=self.history.stored.get(number, ""),
                record_sha256=self.history.sealed.get(number, ()),
                indexed=self.index.get(number),
                has_chain_file=self.history.exists,
                is_chained=is_chained,
                is_flown=self.is_flown,
            )
            for number in numbers
        ]
        found = self._check_all(expected, self.step)
        for one in found:
            self.problems += one.problems
            for (what, by), names in one.covered.items():
                self._cover(what, by, *(f"L0/{one.name}/{name}" for name in names))
            for name, reason in one.not_covered.items():
                self.left.pop(f"L0/{one.name}/{name}", None)
                self.not_covered[f"L0/{one.name}/{name}"] = reason
        return {one.number: one for one in found}

    def _records(self, exposures: dict[int, FoundExposure], genesis: str) -> None:
        """The chain of hashes from record to record.

        In flight a record may be sealed between two looks; those the chain file did not name when
        it was read are left to the next verification.
        """
        links = [
            ChainLink(found.number, found.record_sha256, found.previous_sha256)
            for found in exposures.values()
            if found.record_sha256
            and (found.number in self.history.sealed or not (self.is_flown and self.history.exists))
        ]
        self.problems += follow_chain(links, genesis).problems

    def _index(self, exposures: dict[int, FoundExposure]) -> None:
        if self.index_error:
            # A service that has just begun makes it after the mission's folder.
            is_early = self.is_flown or not self.mission.catalog_path.exists()
            if exposures or not is_early:
                self.problems.append(self.index_error)
            return
        for number, found in exposures.items():
            row = self.index.get(number)
            if row is None:
                if found.is_there and not self.is_flown:
                    self.problems.append(f"exposure {number}: has a folder but no row in the index")
            elif found.record_sha256 and not row.record_sha256:
                if not self.is_flown:
                    self.problems.append(f"exposure {number}: is not called sealed by the index")
            elif row.record_sha256 not in (
                "",
                *self.history.sealed.get(number, (row.record_sha256,)),
            ):
                self.problems.append(f"exposure {number}: the index names another record")
            elif found.is_readable and found.is_there and row.frames != found.frames:
                self.problems.append(f"exposure {number}: index and record name different frames")

    def _products(self) -> None:
        checked = check_products(self.mission, self.inventory, self.step)
        self.problems += checked.problems
        if checked.files:
            self._cover("products", MANIFESTS, *checked.files)

    def _logs(self, *, is_flown_mission: bool) -> None:
        logs: dict[str, LogSeal | None] = dict(self.history.logs)
        by = CHAIN_FILE
        if not self.history.exists and f"log/{SEALS_FILE}" in self.left:
            by = f"log/{SEALS_FILE}"
            try:
                logs |= read_seals(self.mission)
            except RecordError as error:
                self.problems += error.problems
        if f"log/{SEALS_FILE}" in self.left:
            del self.left[f"log/{SEALS_FILE}"]
            self.not_covered[f"log/{SEALS_FILE}"] = "seals of logs by format 1, without a hash"
        for name, seal in sorted(logs.items()):
            path = f"log/{name}"
            if path not in self.inventory.files:
                self.problems.append(f"log {name}: is missing")
            elif seal is not None:
                self._cover("flight logs", by, path)
                self._check_log(name, seal)
        for path in [p for p in self.left if p.startswith("log/") and p.endswith(".mcap")]:
            name = path.removeprefix("log/")
            if self.history.exists and name not in logs and not self.is_flown:
                del self.left[path]
                self.problems.append(f"log {name}: is not in {CHAIN_FILE}; it was added by others")
            else:
                del self.left[path]
                self.not_covered[path] = (
                    "flight log, being written"
                    if self.is_flown
                    else "flight log, not sealed (syntopic repair seals it)"
                )

    def _check_log(self, name: str, seal: LogSeal) -> None:
        path = self.mission.log_dir / name
        try:
            nbytes = path.stat().st_size
            if nbytes < seal.nbytes:
                self.problems.append(
                    f"log {name}: was truncated; {seal.nbytes - nbytes} bytes are missing"
                )
            elif nbytes > seal.nbytes or hash_file(path, self.step) != seal.sha256:
                self.problems.append(f"log {name}: was altered after it was sealed")
        except OSError as error:
            self.problems.append(f"log {name}: cannot be read ({error.strerror})")

    def _closing(self) -> None:
        """Files that may change until a run ends."""
        closing = self.history.closing
        if closing is None or self.is_flown:
            if self.history.exists:
                self.remarks.append(
                    f"{CHAIN_FILE} is open: if the newest exposures were removed together with its "
                    "last lines, that cannot be noticed"
                    + ("" if self.is_flown else " (syntopic repair closes it)")
                )
            why = "may be added to until the flight ends"
            self.not_covered |= {p: why for p in CHANGING_FILES if self.left.pop(p, None)}
            return
        files = closing.get("files")
        for name, sha256 in (files if isinstance(files, dict) else {}).items():
            self._check_file(name, str(sha256), CHAIN_FILE)
        if closing.get("by") == "repair":
            self.remarks.append(
                f"{CHAIN_FILE} was closed by repair at {closing.get('utc')}: if the newest "
                "exposures were removed before together with its last lines, that cannot be "
                "noticed"
            )

    def _entries(self) -> None:
        """Files that do not belong in a mission."""
        for path in self.inventory.special_files:
            self.problems.append(
                f"{path}: is a link, a pipe or a device; it was not followed. A mission holds "
                "plain files and folders"
            )
        for path, why in self.inventory.unreadable.items():
            self.problems.append(f"{path or 'the mission folder'}: cannot be read ({why})")
        for name in self.inventory.below("L0"):
            path = f"L0/{name}"
            if is_exposure_name(name) or name == DISCARDED:
                continue
            if not (self.is_flown and is_unfinished(name)):
                self.problems.append(
                    f"{path}: is no exposure; recovery on start sees to what is unfinished"
                )
            inside = [p for p in self.left if p == path or p.startswith(f"{path}/")]
            self.not_covered |= {p: UNFINISHED for p in inside if is_unfinished(p)}
            for p in inside:
                del self.left[p]


def _read_index(mission: Mission, *, is_flown: bool) -> tuple[dict[int, IndexedExposure], str]:
    """Rows by exposure, as of one instant; and what is wrong with the index.

    Without its shared memory SQLite reads the file as it is, which another process may be
    writing: such a finding counts when it is the same in every attempt.
    """
    error_text = ""
    for _ in range(3 if is_flown else 1):
        try:
            catalog = Catalog.read(mission.catalog_path, is_immutable=not is_flown)
            try:
                return catalog.snapshot(), ""
            finally:
                catalog.close()
        except (CatalogError, sqlite3.Error) as error:
            error_text = str(error)
    return {}, error_text
