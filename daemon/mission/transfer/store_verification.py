"""A mission in an object store: its manifest, and whether every object is what was transferred.

Each object is read once, in parts, and nothing is written to a disk. Frames are also compared with
the hashes in the exposures' own records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from daemon.mission.canonical_json import RECORD_MAX_BYTES, RecordError, parse_record
from daemon.mission.layout import Mission, is_exposure_name
from daemon.mission.store.level0_folder import CAPTURE_FILE, EXPOSURE_FILE
from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError, StoredObject
from daemon.mission.transfer.store_products import (
    PROCESSED,
    is_processed,
    list_products,
    product_differences,
)
from daemon.mission.transfer.transfer_manifest import (
    EXCLUDED_FILES,
    MANIFEST_FILE,
    TransferError,
    TransferManifest,
    parse_manifest,
)
from daemon.mission.verification.verification import CoveredFiles, VerifyReport

MANIFEST_MAX_BYTES = 1_000_000_000
READERS = 4
"""Objects read at a time, each in parts."""


def read_store_manifest(
    target: ObjectStore, mission: Mission | None = None
) -> TransferManifest | None:
    """The manifest of a copy in a store; None where the folder has none.

    Args:
        target: the folder of the copy.
        mission: refuse a copy of any other mission.

    Raises:
        TransferError: damaged, or of another mission.
        ObjectStoreError: the store refused.
    """
    entry = target.find(MANIFEST_FILE)
    if entry is None:
        return None
    if entry.nbytes > MANIFEST_MAX_BYTES:
        raise TransferError(f"{target.url}/{MANIFEST_FILE} is too large for a manifest")
    return parse_manifest(b"".join(target.blocks(entry)), target.url, mission)


def check_store_copy(
    target: ObjectStore, manifest: TransferManifest, step: Callable[[int], None]
) -> None:
    """Read a copy from the store and compare every object with the manifest.

    Frames are compared with the hashes in their exposures' records, too.

    Raises:
        TransferError: an object is missing or differs.
        ObjectStoreError: the store refused.
    """
    found = {one.name: one for one in target.list_with(manifest.files)}
    problem = next(_differences(target, manifest, found, step), None)
    if problem is None:
        problem = next(iter(_recorded_frames(target, manifest, found).problems), None)
    if problem is not None:
        raise TransferError(f"{problem}; what the source still has is kept")


def verify_in_store(
    target: ObjectStore, progress: Callable[[int, int], None] = lambda done, total: None
) -> VerifyReport:
    """Check a transferred mission in a store.

    Args:
        target: the folder of the mission.
        progress: called with bytes done and bytes in total.

    Returns:
        What was checked and one message for every problem.

    Raises:
        ObjectStoreError: the store refused, or the folder has no manifest.
        TransferError: the manifest is damaged.
    """
    manifest = read_store_manifest(target)
    if manifest is None:
        raise ObjectStoreError(
            f"{target.url}: has no {MANIFEST_FILE}, so no transfer wrote it; name the folder of a "
            "mission that `syntopic transfer` copied"
        )
    problems: list[str] = []
    if manifest.state == "copying":
        problems.append(f"{target.url}: the transfer is not complete; run syntopic transfer again")
    found = {one.name: one for one in target.list_with(manifest.files)}
    done = 0

    def step(count: int) -> None:
        nonlocal done
        done += count
        progress(done, manifest.nbytes)

    problems += _differences(target, manifest, found, step)
    problems += [
        f"{name}: was not written by a transfer; move it away"
        for name in found
        if name not in manifest.files and name not in EXCLUDED_FILES and not is_processed(name)
    ]
    about = manifest.files.get("mission.json")
    if manifest.genesis_sha256 != (about.sha256 if about else ""):
        problems.append("mission.json: is not the one that the manifest names")
    recorded = _recorded_frames(target, manifest, found)
    problems += recorded.problems
    covered = [CoveredFiles("objects of the mission", len(manifest.files), MANIFEST_FILE)]
    products = list_products(target)
    if count := sum(1 for _ in products.committed()):
        problems += product_differences(target, products, lambda _count: None)
        covered.append(CoveredFiles("product sets", count, f"{PROCESSED}/manifests"))
    return VerifyReport(
        recorded.exposures,
        recorded.frames,
        manifest.nbytes,
        tuple(problems),
        covered=tuple(covered),
        remarks=("The chain of records is not followed in a store; a copy on a disk shows more.",),
    )


def _differences(
    target: ObjectStore,
    manifest: TransferManifest,
    found: dict[str, StoredObject],
    step: Callable[[int], None],
) -> Iterator[str]:
    """One sentence for every file of the manifest that the store does not have as it was."""

    def compare(name: str) -> str | None:
        there, file = found.get(name), manifest.files[name]
        if there is None:
            return f"{target.url}/{name} is missing"
        if there.nbytes != file.nbytes:
            return f"{target.url}/{name} has {there.nbytes} bytes; {file.nbytes} were transferred"
        if file.sha256 is None:
            return None  # not verified yet: the manifest is in the state "copying"
        if target.sha256(there, step) != file.sha256:
            return f"{target.url}/{name} was changed: another hash than when it was transferred"
        return None

    with ThreadPoolExecutor(READERS) as pool:
        for problem in pool.map(compare, manifest.files):
            if problem is not None:
                yield problem


@dataclass
class _RecordedFrames:
    """Records and frames that were found, and frames that are not what their record names."""

    exposures: int = 0
    frames: int = 0
    problems: list[str] = field(default_factory=list)


def _recorded_frames(
    target: ObjectStore, manifest: TransferManifest, found: dict[str, StoredObject]
) -> _RecordedFrames:
    """Compare frames with the hashes in the records of their exposures.

    The record of the storage counts where an exposure was not sealed.
    """
    recorded = _RecordedFrames()
    folders = {name.rpartition("/")[0] for name in found if name.startswith("L0/")}
    for folder in sorted(folders):
        sealed, stored = (found.get(f"{folder}/{name}") for name in (EXPOSURE_FILE, CAPTURE_FILE))
        record = sealed or stored
        if record is None or not is_exposure_name(folder.removeprefix("L0/")):
            continue
        recorded.exposures += sealed is not None
        counted, wrong = _frames(target, manifest, record, found)
        recorded.frames += counted
        recorded.problems += wrong
    return recorded


def _frames(
    target: ObjectStore,
    manifest: TransferManifest,
    entry: StoredObject,
    found: dict[str, StoredObject],
) -> tuple[int, list[str]]:
    """Frames that a record names, and those whose hash is not that of the copy."""
    folder = entry.name.rpartition("/")[0]
    if entry.nbytes > RECORD_MAX_BYTES:
        return 0, [f"{entry.name}: too large for a record"]
    try:
        record = parse_record(b"".join(target.blocks(entry)), entry.name)
        named = [
            (str(frame["file"]), str(frame.get("sha256", "")))
            for frame in record.get("frames", ())
            if frame.get("file")
        ]
    except (RecordError, KeyError, TypeError, AttributeError) as error:
        return 0, [f"{entry.name}: cannot be read ({error})"]
    wrong = []
    for file, sha256 in named:
        name = f"{folder}/{file}"
        noted, there = manifest.files.get(name), found.get(name)
        if noted is None:
            wrong.append(f"{name}: is missing")
            continue
        if there is None:
            continue  # `_differences` names it
        if sha256 and (noted.sha256 or target.sha256(there, _no_step)) != sha256:
            wrong.append(f"{name}: differs from the hash in its record")
    return len(named), wrong


def _no_step(_count: int) -> None:
    """Bytes read twice are not counted."""
