"""A transferred mission in an object store as a folder without its frames.

Records, rig, configuration and calibrations are fetched and compared with the hashes of the
transfer. In the place of a frame is an empty file of its size that occupies no blocks; its content
is read from the store when it is computed with, and never written to a disk.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.mission.canonical_json import sha256_hex
from daemon.mission.layout import Mission, exposure_name, is_exposure_name
from daemon.mission.store.level0_folder import CAPTURE_FILE, EXPOSURE_FILE
from daemon.mission.transfer.object_store import ObjectStore, ObjectStoreError
from daemon.mission.transfer.store_products import PROCESSED, answers
from daemon.mission.transfer.store_verification import read_store_manifest
from daemon.mission.transfer.transfer_manifest import CopiedFile, TransferManifest

RECORDS: Final = (EXPOSURE_FILE, CAPTURE_FILE)
_LEFT_OUT: Final = frozenset(
    {"L0", "L2", "L3", "export", "log", "manifests", "thumbnails", PROCESSED}
)
"""Folders that no computation of Level-2 reads as a whole."""
_INDEX: Final = "mission.db"

Files = Mapping[str, CopiedFile]


@dataclass(frozen=True)
class StoredMission:
    """A mission in a store: its folder there, and what the transfer noted of every file.

    `exposures` has the files of Level-0 by exposure and name.
    """

    store: ObjectStore
    manifest: TransferManifest
    exposures: Mapping[int, Files]

    def fetch(self, folder: Path, numbers: Iterable[int]) -> Mission:
        """The mission with the records of some exposures, as a folder without frames.

        Args:
            folder: empty; the mission becomes a folder in it.
            numbers: of the exposures.

        Raises:
            ObjectStoreError: the store refused, or an object is not the one that was transferred.
        """
        path = fetch_shared(self.store, self.manifest, folder)
        numbers = list(numbers)
        answers(lambda n: fetch_exposure(self.store, path, n, self.exposures[n]), numbers)
        return Mission.open(path)


def open_stored(url: str) -> StoredMission:
    """A mission that `syntopic transfer` copied into a store.

    Args:
        url: of its folder.

    Raises:
        ObjectStoreError: the store refused, or has no complete mission there.
        TransferError: the manifest is damaged.
    """
    store = ObjectStore(url)
    manifest = read_store_manifest(store)
    if manifest is None:
        raise ObjectStoreError(
            f"{store.url}: has no mission that a transfer wrote; run: syntopic transfer"
        )
    if manifest.state == "copying":
        raise ObjectStoreError(
            f"{store.url}: the transfer is not complete; run syntopic transfer again"
        )
    exposures: dict[int, dict[str, CopiedFile]] = {}
    for name, file in manifest.files.items():
        parts = name.split("/")
        if len(parts) == 3 and parts[0] == "L0" and is_exposure_name(parts[1]):
            exposures.setdefault(int(parts[1]), {})[parts[2]] = file
    if not exposures:
        raise ObjectStoreError(f"{store.url}: the mission has no exposures in L0")
    return StoredMission(store, manifest, exposures)


def fetch_shared(store: ObjectStore, manifest: TransferManifest, folder: Path) -> Path:
    """Fetch what all exposures have in common; returns the folder of the mission.

    Args:
        store: folder of the mission there.
        manifest: of the transfer.
        folder: empty; the mission becomes a folder in it.

    Raises:
        ObjectStoreError: the store refused, or an object is not the one that was transferred.
    """
    path = folder / store.url.rpartition("/")[2]
    (path / "L0").mkdir(parents=True)
    names = [
        name
        for name in manifest.files
        if name.split("/", 1)[0] not in _LEFT_OUT and not name.startswith(_INDEX)
    ]
    answers(lambda name: _fetch(store, name, manifest.files[name], path), names)
    return path


def fetch_exposure(store: ObjectStore, path: Path, number: int, files: Files) -> None:
    """Fetch the records of an exposure; each frame becomes an empty file of its size.

    Args:
        store: folder of the mission there.
        path: folder of the mission here.
        number: of the exposure.
        files: of its Level-0 folder.

    Raises:
        ObjectStoreError: the store refused, or a record is not the one that was transferred.
    """
    below = f"L0/{exposure_name(number)}"
    (path / below).mkdir(exist_ok=True)
    for name, file in files.items():
        if name in RECORDS:
            _fetch(store, f"{below}/{name}", file, path)
            continue
        with (path / below / name).open("wb") as placeholder:
            os.truncate(placeholder.fileno(), file.nbytes)


def _fetch(store: ObjectStore, name: str, file: CopiedFile, path: Path) -> None:
    target = path / name
    data = store.read(name, file.nbytes)
    if sha256_hex(data) != file.sha256:
        raise ObjectStoreError(
            f"{store.url}/{name} was changed: another hash than when it was transferred. Run: "
            f"syntopic verify {store.url}"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
