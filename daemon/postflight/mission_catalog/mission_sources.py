"""Where the missions of a catalog are: folders, folders of missions, and object stores.

Of a mission in a store only records, rig and configuration are fetched, into a temporary folder.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from daemon import DaemonError
from daemon.mission.layout import Mission, exposure_name, is_exposure_name
from daemon.mission.store.durable import make_directories
from daemon.mission.store.product_manifests import REPORT_FILE
from daemon.mission.transfer.object_store import ObjectStore, StoredObject, is_store_url
from daemon.mission.transfer.store_products import (
    list_products,
    product_folder,
    stored_provenance,
)

RECORD_MAX_BYTES = 20_000_000
_ROOT_FILES = ("mission.json", "rig.toml", "service.toml")


class SourceError(DaemonError):
    """A place without a mission; the message names it."""


@contextmanager
def missions_at(source: str) -> Iterator[list[tuple[Mission, str]]]:
    """The missions at a place, and the folder or address of each.

    Args:
        source: a mission folder, a folder of missions, or one of these in a store.

    Raises:
        SourceError: there is none.
        ObjectStoreError: the store refused.
    """
    if is_store_url(source):
        with tempfile.TemporaryDirectory(prefix="syntopic-catalog-") as scratch:
            yield _fetched(ObjectStore(source), Path(scratch))
        return
    folder = Path(source).resolve()
    folders = [folder, *sorted(p for p in folder.glob("*/") if not p.name.startswith("."))]
    found = [Mission.open(one) for one in folders if (one / "L0").is_dir()]
    if not found:
        raise SourceError(f"{source}: no mission there; a mission has a folder L0")
    yield [(mission, str(mission.path)) for mission in found]


def _fetched(store: ObjectStore, scratch: Path) -> list[tuple[Mission, str]]:
    """Records of the missions in a store, as folders without frames."""
    missions: dict[str, list[tuple[StoredObject, PurePosixPath]]] = {}
    for entry in store.list_objects():
        path = PurePosixPath(entry.name)
        for depth in (0, 1):
            below = PurePosixPath(*path.parts[depth:])
            if _is_record(below):
                root = path.parts[0] if depth else ""
                missions.setdefault(root, []).append((entry, below))
                break
    found = []
    for root, entries in sorted(missions.items()):
        if not any(below.parts[0] == "L0" for _, below in entries):
            continue
        name = root or store.url.rpartition("/")[2]
        folder = scratch / name
        for entry, below in entries:
            if entry.nbytes > RECORD_MAX_BYTES:
                raise SourceError(f"{store.url}/{entry.name}: too large for a record")
            make_directories((folder / below).parent)
            (folder / below).write_bytes(b"".join(store.blocks(entry)))
        address = f"{store.url}/{root}" if root else store.url
        _fetch_processed(ObjectStore(address), folder)
        found.append((Mission.open(folder), address))
    if not found:
        raise SourceError(f"{store.url}: no mission there; a mission has records in L0")
    return found


def _fetch_processed(store: ObjectStore, folder: Path) -> None:
    """Quality reports of products that were computed in the store; of several keys the last one."""
    products = list_products(store)
    newest: dict[int, tuple[float, str]] = {}
    for number, key in products.committed():
        finished_s = stored_provenance(store, number, key).get("finished_unix_s", 0)
        instant_s = float(finished_s) if isinstance(finished_s, int | float) else 0.0
        newest[number] = max(newest.get(number, (-1.0, "")), (instant_s, key))
    for number, (_, key) in newest.items():
        report = f"{product_folder(number, key)}/{REPORT_FILE}"
        entry = store.find(report)
        if entry is None or entry.nbytes > RECORD_MAX_BYTES:
            raise SourceError(f"{store.url}/{report}: is missing or too large for a report")
        make_directories(folder / "L2" / exposure_name(number))
        target = folder / "L2" / exposure_name(number) / REPORT_FILE
        target.write_bytes(b"".join(store.blocks(entry)))


def _is_record(path: PurePosixPath) -> bool:
    """Whether an object of a mission is small and needed: names come from anywhere."""
    parts = path.parts
    if any(part in ("..", ".") or os.sep in part for part in parts):
        return False
    if len(parts) == 1:
        return parts[0] in _ROOT_FILES
    wanted = {"L0": "exposure.json", "L2": "quality.json"}
    return len(parts) == 3 and is_exposure_name(parts[1]) and wanted.get(parts[0]) == parts[2]
