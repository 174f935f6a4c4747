"""Products of a mission in an object store: objects below their key, and a manifest as the commit.

Products are next to the transferred mission, in the folder `processed` of it, which no transfer
writes. Objects are below the key of what they were computed from, and their bytes are decided by
it: a second writer replaces them by the same bytes. The manifest is written last, by a conditional
put. Host, versions and all durations, those of quality.json too, are in a sidecar.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

from daemon.mission.canonical_json import RecordError, canonical_bytes, parse_record, sha256_hex
from daemon.mission.layout import exposure_name, is_exposure_name
from daemon.mission.store.product_manifests import (
    REPORT_FILE,
    UNCOMPARED_KEYS,
    Parts,
    ProductFile,
    ProductManifest,
    duration_of,
    manifest_of,
    parse_manifest,
    parts_sha256,
)
from daemon.mission.transfer.object_store import (
    PART_BYTES,
    REQUESTS,
    ObjectStore,
    ObjectStoreError,
)

PROCESSED: Final = "processed"
MANIFEST_MAX_BYTES: Final = 10_000_000
WRITERS: Final = 4
"""Objects of one exposure sent at a time; each holds at most three parts in memory."""
_KEY = re.compile(r"[0-9a-f]{64}")


def is_processed(name: str) -> bool:
    """Whether an object of a mission's folder is a product that was computed in the store."""
    return name.startswith(f"{PROCESSED}/")


def product_folder(number: int, key: str) -> str:
    """The folder of an exposure's products, below that of the mission."""
    return f"{PROCESSED}/L2/{exposure_name(number)}/{key}"


def manifest_name(number: int, key: str) -> str:
    """The object that commits an exposure's products."""
    return f"{PROCESSED}/manifests/L2/{exposure_name(number)}/{key}.json"


def provenance_name(number: int, key: str) -> str:
    """The sidecar with host, versions and durations."""
    return manifest_name(number, key).removesuffix(".json") + ".provenance.json"


@dataclass(frozen=True)
class StoredProducts:
    """What was found of a mission's products by one listing: sizes by folder and name."""

    sizes: Mapping[str, Mapping[str, int]]

    def agrees(self, number: int, manifest: ProductManifest) -> bool:
        """Whether every object of a manifest is there with its size, and no other one.

        Args:
            number: of the exposure.
            manifest: of its products.
        """
        found = self.sizes.get(product_folder(number, manifest.key), {})
        return found == {name: file.nbytes for name, file in manifest.files.items()}

    def is_committed(self, number: int, key: str) -> bool:
        """Whether there is a manifest of a key; nothing is known of its content.

        Args:
            number: of the exposure.
            key: SHA-256 of what the products are computed from.
        """
        folder, _, name = manifest_name(number, key).rpartition("/")
        return name in self.sizes.get(folder, {})

    def committed(self) -> Iterator[tuple[int, str]]:
        """Exposure and key of every manifest."""
        for folder, names in sorted(self.sizes.items()):
            parent, _, exposure = folder.rpartition("/")
            if parent != f"{PROCESSED}/manifests/L2" or not is_exposure_name(exposure):
                continue
            for name in sorted(names):
                key, _, suffix = name.partition(".")
                if suffix == "json" and _KEY.fullmatch(key):
                    yield int(exposure), key


def list_products(
    store: ObjectStore, below: str = PROCESSED, names: Iterable[str] = ()
) -> StoredProducts:
    """Products of a mission, or of one folder of it.

    Args:
        store: folder of the mission.
        below: folder in it.
        names: in that folder, which are asked for where the list misses them.

    Raises:
        ObjectStoreError: the store refused.
    """
    sizes: dict[str, dict[str, int]] = {}
    for one in store.list_with([f"{below}/{name}" for name in names], below):
        folder, _, name = one.name.rpartition("/")
        sizes.setdefault(folder, {})[name] = one.nbytes
    return StoredProducts(sizes)


def read_stored_manifest(store: ObjectStore, number: int, key: str) -> ProductManifest | None:
    """The manifest of a key; None where there is none that can be read.

    Args:
        store: folder of the mission.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.

    Raises:
        ObjectStoreError: the store refused.
    """
    entry = store.find(manifest_name(number, key))
    if entry is None or entry.nbytes > MANIFEST_MAX_BYTES:
        return None
    return parse_manifest(b"".join(store.blocks(entry)), key)


def is_stored(store: ObjectStore, number: int, key: str) -> bool:
    """Whether the products of a key are committed and all there, by looking.

    Args:
        store: folder of the mission.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.

    Raises:
        ObjectStoreError: the store refused.
    """
    manifest = read_stored_manifest(store, number, key) if key else None
    if manifest is None:
        return False
    return list_products(store, product_folder(number, key), manifest.files).agrees(
        number, manifest
    )


def publish_stored(
    store: ObjectStore, number: int, key: str, contents: Mapping[str, Parts]
) -> tuple[ProductManifest, dict[str, Any]]:
    """Write products below their key; they are not yet committed.

    Args:
        store: folder of the mission.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.
        contents: bytes by file name, with quality.json.

    Returns:
        The manifest, and what of quality.json is no part of it.

    Raises:
        ObjectStoreError: the store refused, or does not have what was written.
    """
    full = parse_record(b"".join(contents[REPORT_FILE]), REPORT_FILE)
    report = {name: value for name, value in full.items() if name not in UNCOMPARED_KEYS}
    durations = {name: value for name, value in full.items() if name in UNCOMPARED_KEYS}
    written = {**contents, REPORT_FILE: [canonical_bytes(report)]}
    folder = product_folder(number, key)

    def put(name: str) -> ProductFile:
        parts = [memoryview(part).cast("B") for part in written[name]]
        file = ProductFile(sum(part.nbytes for part in parts), parts_sha256(parts))
        store.put(f"{folder}/{name}", _opener(parts), file.nbytes, file.sha256)
        return file

    names = sorted(written)
    with ThreadPoolExecutor(WRITERS) as pool:
        files = dict(zip(names, pool.map(put, names), strict=True))
    manifest = manifest_of(key, files, report)
    if not list_products(store, folder, files).agrees(number, manifest):
        raise ObjectStoreError(
            f"{store.url}/{folder}: does not hold what was written; run the same command again"
        )
    return manifest, durations


def commit_stored(
    store: ObjectStore, number: int, manifest: ProductManifest, provenance: Mapping[str, Any]
) -> bool:
    """Commit published products: provenance first, the manifest last and at most once.

    Args:
        store: folder of the mission.
        number: of the exposure.
        manifest: as `publish_stored` returned it.
        provenance: host, versions and durations.

    Returns:
        Whether this call committed; False where the key was committed already.

    Raises:
        ObjectStoreError: the store refused, or a damaged manifest is there.
    """
    name = manifest_name(number, manifest.key)
    if read_stored_manifest(store, number, manifest.key) == manifest:
        return False
    # Of two runs that finish at once the sidecar is that of either: their products are the same.
    data = canonical_bytes(dict(provenance))
    store.put(
        provenance_name(number, manifest.key), lambda: iter([data]), len(data), sha256_hex(data)
    )
    return store.create_small(name, canonical_bytes(manifest.as_json()))


def stored_provenance(store: ObjectStore, number: int, key: str) -> dict[str, Any]:
    """Host, versions and durations of a computation; empty where they are not known.

    Args:
        store: folder of the mission.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.

    Raises:
        ObjectStoreError: the store refused.
    """
    return _record(store, provenance_name(number, key))


def stored_reports(store: ObjectStore, keys: Mapping[int, str]) -> dict[int, dict[str, Any]]:
    """Quality reports of committed products with their durations.

    Args:
        store: folder of the mission.
        keys: of the products, by exposure.

    Raises:
        ObjectStoreError: the store refused.
    """

    def report(number: int) -> dict[str, Any]:
        key = keys[number]
        provenance = stored_provenance(store, number, key)
        timings = {name: provenance[name] for name in UNCOMPARED_KEYS if name in provenance}
        own = _record(store, f"{product_folder(number, key)}/{REPORT_FILE}")
        return {**own, **timings, "duration_s": duration_of(provenance) or 0.0}

    return dict(zip(keys, answers(report, keys), strict=True))


def product_differences(
    store: ObjectStore, found: StoredProducts, step: Callable[[int], None]
) -> Iterator[str]:
    """One sentence for every committed product that is missing or was altered.

    Objects without a manifest are of a run that was stopped, and no error.

    Args:
        store: folder of the mission.
        found: its products.
        step: called with bytes that were read.

    Raises:
        ObjectStoreError: the store refused.
    """
    for number, key in found.committed():
        manifest = read_stored_manifest(store, number, key)
        if manifest is None:
            yield f"{manifest_name(number, key)}: is damaged, or of another key"
            continue
        folder = product_folder(number, key)
        for name, file in manifest.files.items():
            entry = store.find(f"{folder}/{name}")
            if entry is None:
                yield f"{folder}/{name}: is missing"
            elif entry.nbytes != file.nbytes or store.sha256(entry, step) != file.sha256:
                yield f"{folder}/{name}: differs from its manifest"


def answers(ask: Callable[[Any], Any], what: Iterable[Any]) -> list[Any]:
    """Answers to small requests, several at a time, in order.

    Args:
        ask: one request.
        what: argument of each.
    """
    with ThreadPoolExecutor(REQUESTS) as pool:
        return list(pool.map(ask, what))


def _record(store: ObjectStore, name: str) -> dict[str, Any]:
    entry = store.find(name)
    if entry is None or entry.nbytes > MANIFEST_MAX_BYTES:
        return {}
    try:
        return parse_record(b"".join(store.blocks(entry)), name)
    except RecordError:
        return {}


def _opener(parts: list[memoryview]) -> Callable[[], Iterator[bytes]]:
    """Opens the content of a file again at each call, in blocks."""

    def blocks() -> Iterator[bytes]:
        for part in parts:
            for start in range(0, part.nbytes, PART_BYTES):
                yield bytes(part[start : start + PART_BYTES])

    return blocks
