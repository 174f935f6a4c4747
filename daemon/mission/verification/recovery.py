"""At startup: make index, records, logs and disk agree, and report what was done.

Whatever was called stored is kept; whole folders that were only not renamed yet are kept too; what
is stored but unsealed is sealed from the flight log. Running it twice changes nothing more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.catalog.catalog import Catalog, CatalogError
from daemon.mission.exposure import CaptureRecord, Exposure
from daemon.mission.layout import DISCARDED, Mission, exposure_name
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.log.log_records import LoggedRecord, LoggedTrigger, record_of
from daemon.mission.store import durable, level2
from daemon.mission.store.level0_folder import (
    CAPTURE_FILE,
    EXPOSURE_FILE,
    SealedRecord,
    hash_file,
    read_capture,
    read_sealed,
)
from daemon.mission.store.store import Level0Writer
from daemon.mission.verification.chain import ChainLink, ChainReport, follow_chain
from daemon.mission.verification.chain_file import CHAIN_FILE, ChainFile
from processing.rig import RigError, load_rig

CONTEXT_NS = 60_000_000_000
"""Records of the log this long before and after a trigger belong to what seals its exposure."""

LEDGER_TOPIC = "ledger"

Complete = Callable[[CaptureRecord, Sequence[LoggedRecord]], Exposure]
"""Makes the final record of a stored exposure from what was logged around it."""


@dataclass(frozen=True)
class RecoveryReport:
    """Result of recovery. `problems` are what it could not repair, `notices` what needs
    no action and is reported at every start.

    `sealed` and `lost` are the numbers it sealed just now; `finalized` are all sealed records by
    number, for the ledger, and `ledger_sheet` the last one that was logged under the topic
    "ledger"; `next_number` is the one to go on with, beyond every trigger that was ever given.
    """

    done: tuple[str, ...]
    problems: tuple[str, ...]
    notices: tuple[str, ...]
    sealed: tuple[int, ...]
    lost: tuple[int, ...]
    next_number: int
    finalized: tuple[Exposure, ...]
    ledger_sheet: Mapping[str, Any] | None
    log_bytes_cut: int

    @property
    def sentences(self) -> tuple[str, ...]:
        """All messages to the crew, problems first."""
        return (*self.problems, *self.done, *self.notices)


def recover(mission: Mission, complete: Complete, *, software: str = "") -> RecoveryReport:
    """Recover a mission; to be run before anything else writes into it.

    Args:
        mission: it must be held by the caller (`Mission.held`).
        complete: pure; called once for each exposure to be sealed, in order of number.
        software: goes into the record of an exposure of which nothing but its trigger is known.

    Raises:
        OSError: the disk refused; recovery may be run again.
    """
    return _Recovery(mission, complete, software).run()


@dataclass
class _Log:
    """Records of the flight logs for the exposures that need them."""

    triggers: dict[int, tuple[str, LoggedTrigger]] = field(default_factory=dict)
    sheet: Mapping[str, Any] | None = None
    cut_nbytes: int = 0


class _Recovery:
    def __init__(self, mission: Mission, complete: Complete, software: str) -> None:
        self.mission = mission
        self.complete = complete
        self.software = software
        self.done: list[str] = []
        self.problems: list[str] = []
        self.notices: list[str] = []
        self.removed: set[int] = set()
        self.unsealed: set[int] = set()
        self._altered: set[int] = set()

    def run(self) -> RecoveryReport:
        self._parts()
        self.done += level2.recover_level2(self.mission)
        sealed, captures = self._read_folders()
        chain = self._chain(sealed)
        chain_file = self.mission.open_chain()
        catalog = self._index(sealed, captures, chain)
        try:
            indexed = [row.number for row in catalog.exposures()]
            known = {*indexed, *chain_file.history.numbers}
            self._chain_file(chain_file, sealed, captures, chain)
            self._index_products(catalog)
            log = self._triggers()
            newly, lost = self._seal(catalog, chain_file, captures, sealed, log, known)
            self._note(catalog)
        finally:
            catalog.close()
            chain_file.close()
        next_number = 1 + max([self.mission.next_number() - 1, *log.triggers, *known])
        return RecoveryReport(
            done=tuple(self.done),
            problems=tuple(self.problems),
            notices=tuple(self.notices),
            sealed=tuple(newly),
            lost=tuple(lost),
            next_number=next_number,
            finalized=tuple(sealed[number].exposure for number in sorted(sealed)),
            ledger_sheet=log.sheet,
            log_bytes_cut=log.cut_nbytes,
        )

    def _note(self, catalog: Catalog) -> None:
        """Into the index what the crew may want to read after landing; what stays, only once."""
        known = {sentence for source, _, sentence in catalog.events() if source == "recovery"}
        new = [("done", sentence) for sentence in self.done]
        new += [("problem", sentence) for sentence in self.problems if sentence not in known]
        new += [("noticed", sentence) for sentence in self.notices if sentence not in known]
        for name, sentence in new:
            is_fault = name == "problem"
            catalog.add_event("recovery", name, sentence, is_fault=is_fault, mono_ns=0, boot_id="")

    def _parts(self) -> None:
        """Folders without their final name: complete ones get it, the others are discarded."""
        for part in sorted(self.mission.level0_root.glob(f"*{durable.PART_SUFFIX}")):
            final = part.with_name(part.name.removesuffix(durable.PART_SUFFIX))
            if not final.exists() and _is_complete(part):
                durable.rename_directory(part, final)
                self.done.append(f"exposure {final.name}: was whole but unnamed; kept as stored")
            else:
                self._discard(part, final.name)
        for number in self.mission.numbers():
            folder = self.mission.level0(number)
            if durable.remove_parts(folder / EXPOSURE_FILE):
                durable.sync_directory(folder)
                self.done.append(f"exposure {number}: a record written half was removed")

    def _discard(self, part: Path, name: str) -> None:
        discarded = self.mission.level0_root / DISCARDED
        durable.make_directories(discarded)
        repetition = 1
        while (target := discarded / f"{name}-{repetition}").exists():
            repetition += 1
        part.rename(target)
        durable.sync_directory(discarded)
        durable.sync_directory(part.parent)
        self.done.append(
            f"exposure {name}: was being written and never called stored; "
            f"its files are in L0/{DISCARDED}/{target.name}"
        )

    def _read_folders(self) -> tuple[dict[int, SealedRecord], dict[int, CaptureRecord]]:
        sealed: dict[int, SealedRecord] = {}
        captures: dict[int, CaptureRecord] = {}
        for number in self.mission.numbers():
            folder = self.mission.level0(number)
            try:
                record = read_sealed(folder)
                capture = read_capture(folder)
            except RecordError as error:
                self.problems += error.problems
                continue
            if record is not None:
                sealed[number] = record
            if capture is not None:
                captures[number] = capture
            if record is None and capture is None:
                self.problems.append(
                    f"exposure {number}: its folder has no record; it is left as it is"
                )
        return sealed, captures

    def _chain(self, sealed: Mapping[int, SealedRecord]) -> ChainReport:
        links = [ChainLink(n, r.sha256, r.exposure.previous_sha256) for n, r in sealed.items()]
        chain = follow_chain(links, self.mission.genesis_sha256())
        self.problems += chain.problems
        return chain

    def _index(
        self,
        sealed: Mapping[int, SealedRecord],
        captures: Mapping[int, CaptureRecord],
        chain: ChainReport,
    ) -> Catalog:
        """The index, made to say what the folders say."""
        catalog = self._open_index()
        rows = {row.number: row for row in catalog.exposures()}
        # The row of an exposure whose folder is gone stays: it is a witness.
        self.removed = set(rows) - set(self.mission.numbers())
        self.unsealed = {
            number
            for number in set(captures) - set(sealed)
            if number in rows and rows[number].is_sealed
        }
        for number in sorted(set(captures) - set(rows)):
            catalog.add_stored(captures[number])
            self.done.append(f"exposure {number}: has its folder; taken into the index")
        for link in chain.order:
            row = rows.get(link.number)
            if row is not None and row.is_sealed:
                if row.record_sha256 != link.sha256:
                    self._altered.add(link.number)
                continue
            catalog.add_sealed(sealed[link.number].exposure, link.sha256)
            self.done.append(f"exposure {link.number}: is sealed; noted in the index")
        return catalog

    def _chain_file(
        self,
        chain_file: ChainFile,
        sealed: Mapping[int, SealedRecord],
        captures: Mapping[int, CaptureRecord],
        chain: ChainReport,
    ) -> None:
        """The chain file, completed by what became durable and was not noted in it."""
        history = chain_file.history
        self.problems += history.problems
        if history.rebuilt_utc and chain_file.is_new:
            self.problems.append(
                f"{CHAIN_FILE}: is missing; written again from what is there, so that what was "
                "removed before cannot be noticed"
            )
        if chain_file.cut_nbytes:
            self.done.append(
                f"{CHAIN_FILE}: {chain_file.cut_nbytes} bytes of an unfinished line were removed"
            )
        removed = self.removed | (history.numbers - set(self.mission.numbers()))
        self.problems += [
            f"exposure {number}: was stored but its folder is gone; it was removed by others"
            for number in sorted(removed)
        ]
        unsealed = self.unsealed | (set(history.sealed) & (set(captures) - set(sealed)))
        self.problems += [
            f"exposure {number}: was sealed but its record is gone; it is sealed again"
            for number in sorted(unsealed)
        ]
        for number in sorted(captures.keys() - history.stored.keys()):
            chain_file.stored(number, hash_file(self.mission.level0(number) / CAPTURE_FILE))
        for link in chain.order:
            hashes = history.sealed.get(link.number, ())
            if not hashes:
                chain_file.sealed(link.number, link.sha256)
            elif link.sha256 not in hashes:
                self._altered.add(link.number)
        self.problems += [
            f"exposure {number}: its record was altered since it was sealed"
            for number in sorted(self._altered)
        ]

    def _index_products(self, catalog: Catalog) -> None:
        """Products the index does not know, as after the index was lost."""
        known = catalog.processed_numbers()
        for number in self.mission.numbers():
            folder = self.mission.level2(number)
            if number in known or not folder.is_dir():
                continue
            files = {entry.name: entry.stat().st_size for entry in folder.iterdir()}
            catalog.add_products(number, files, level2.verdict_of(folder))

    def _open_index(self) -> Catalog:
        path = self.mission.catalog_path
        if not path.exists() and self.mission.numbers():
            self.done.append("the index was missing; built again from the records")
        try:
            return Catalog.open(path)
        except CatalogError as error:
            discarded = path.with_name(f"{path.name}.damaged")
            repetition = 1
            while discarded.exists():
                repetition += 1
                discarded = path.with_name(f"{path.name}.damaged-{repetition}")
            path.rename(discarded)
            for suffix in ("-wal", "-shm"):
                path.with_name(path.name + suffix).unlink(missing_ok=True)
            durable.sync_directory(path.parent)
            self.done.append(
                f"the index was unusable ({error}); kept as {discarded.name}, built again"
            )
            return Catalog.open(path)

    def _triggers(self) -> _Log:
        log = _Log()
        for path in logs_of(self.mission.log_dir):
            reader = read(path)
            for message in reader:
                if message.topic == "trigger":
                    record = record_of(message)
                    if isinstance(record, LoggedTrigger):
                        log.triggers[record.number] = (reader.boot_id, record)
                elif message.topic == LEDGER_TOPIC:
                    with suppress(RecordError):
                        log.sheet = parse_record(message.payload, message.topic)
            if reader.cut_nbytes:
                log.cut_nbytes += reader.cut_nbytes
                self.notices.append(
                    f"log/{path.name}: ends in the middle of a message; "
                    f"{reader.cut_nbytes} bytes cannot be read"
                )
            if reader.bad_checkpoints:
                self.problems.append(f"log/{path.name}: was damaged on the disk; read with care")
        return log

    def _seal(
        self,
        catalog: Catalog,
        chain_file: ChainFile,
        captures: Mapping[int, CaptureRecord],
        sealed: dict[int, SealedRecord],
        log: _Log,
        known: AbstractSet[int],
    ) -> tuple[list[int], list[int]]:
        """Seal what is stored but unsealed, and what was triggered and left nothing.

        Of the exposures `known` to have been stored none is called lost: one whose folder is gone
        was removed.
        """
        waiting = {n: c for n, c in captures.items() if n not in sealed}
        present_or_removed = known | set(self.mission.numbers())
        lost = [number for number in sorted(log.triggers) if number not in present_or_removed]
        for number in lost:
            waiting[number] = self._capture_of_lost(*log.triggers[number])
        if not waiting:
            return [], []
        records = _logged_around(self.mission.log_dir, waiting)
        writer = Level0Writer(self.mission, catalog=catalog, chain=chain_file)
        newly = []
        try:
            for number in sorted(waiting):
                try:
                    exposure = self.complete(waiting[number], records[number])
                except RecordError as error:
                    self.problems += [f"exposure {number}: not sealed: {p}" for p in error.problems]
                    continue
                if not exposure.frames:
                    exposure = replace(exposure, state="lost")
                writer.seal(exposure)
                record = read_sealed(self.mission.level0(number))
                if record is not None:
                    sealed[number] = record
                newly.append(number)
                how = (
                    "was triggered but never stored; recorded as lost"
                    if number in lost
                    else f"was stored but not sealed; sealed from the log ({exposure.mark_source})"
                )
                self.done.append(f"exposure {number}: {how}")
        finally:
            writer.close()
        return newly, [number for number in lost if number in newly]

    def _capture_of_lost(self, boot_id: str, trigger: LoggedTrigger) -> CaptureRecord:
        cause = "the service ended before its frame was stored"
        try:
            sensors = [sensor.name for sensor in load_rig(self.mission.rig_path).sensors]
        except RigError:
            sensors = []
        return CaptureRecord(
            number=trigger.number,
            trigger_sequence=trigger.pulse.sequence,
            trigger_mono_ns=trigger.pulse.mono_ns,
            trigger_sigma_ns=trigger.pulse.sigma_ns,
            boot_id=boot_id,
            missing=tuple((sensor, cause) for sensor in sensors),
            software=self.software,
        )


def _is_complete(part: Path) -> bool:
    """Whether every frame named in a part folder's record is there and has its recorded hash."""
    try:
        capture = read_capture(part)
    except RecordError:
        return False
    if capture is None or exposure_name(capture.number) + durable.PART_SUFFIX != part.name:
        return False
    for frame in capture.frames:
        try:
            if hash_file(part / frame.file) != frame.sha256:
                return False
        except OSError:
            return False
    return True


def _logged_around(
    log_dir: Path, waiting: Mapping[int, CaptureRecord]
) -> dict[int, list[LoggedRecord]]:
    """By exposure, what was logged around its trigger on the same boot, in order."""
    found: dict[int, list[LoggedRecord]] = {number: [] for number in waiting}
    for path in logs_of(log_dir):
        reader = read(path)
        for message in reader:
            near = [
                number
                for number, capture in waiting.items()
                if capture.boot_id == reader.boot_id
                and abs(capture.trigger_mono_ns - message.mono_ns) <= CONTEXT_NS
            ]
            record = record_of(message) if near else None
            if record is not None:
                for number in near:
                    found[number].append(record)
    return found
