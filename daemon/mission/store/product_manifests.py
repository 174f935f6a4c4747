"""Manifests of products: the commit of a computation, by the key of what it was computed from.

The manifest of an exposure's products is `manifests/L2/000123/KEY.json`. It is written after the
products have their final name, by link(2), so that of two writers one succeeds. A product set is
complete when the manifest of its key exists and the files agree with it. Host, versions and
duration are in `KEY.provenance.json`, outside of what is compared between two runs.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from daemon import DaemonError
from daemon.mission.canonical_json import RecordError, canonical_bytes, parse_record, sha256_hex
from daemon.mission.layout import Mission, exposure_name
from daemon.mission.store import durable, level2
from daemon.mission.store.publication import StagedFolder

MANIFESTS: Final = "manifests"
REPORT_FILE: Final = "quality.json"
UNCOMPARED_KEYS: Final = frozenset({"timings_s", "duration_s"})
"""Keys of quality.json that state how long things took."""

_FORMAT: Final = 1
_KEY_CHARACTERS: Final = 64
_BLOCK_BYTES: Final = 1 << 20
_DURATION_MAX_S: Final = 1e7

Parts = Sequence[bytes | memoryview]


class ClaimedElsewhereError(DaemonError):
    """Another process computes the products of this exposure now."""


@dataclass(frozen=True)
class ProductFile:
    """Size and hash of one file."""

    nbytes: int
    sha256: str


@dataclass(frozen=True)
class ProductManifest:
    """Files of a complete product set, by name.

    `compared_sha256` is the hash over all names and contents, without the durations in
    quality.json: two computations of one key agree in it.
    """

    key: str
    files: Mapping[str, ProductFile]
    compared_sha256: str

    def as_json(self) -> dict[str, Any]:
        """As an object of JSON types."""
        files = {
            name: {"nbytes": file.nbytes, "sha256": file.sha256}
            for name, file in self.files.items()
        }
        return {
            "format": _FORMAT,
            "key": self.key,
            "compared_sha256": self.compared_sha256,
            "files": files,
        }


def manifest_folder(mission: Mission, number: int) -> Path:
    """The folder of an exposure's manifest."""
    return mission.path / MANIFESTS / mission.level2_root.name / exposure_name(number)


def read_manifest(mission: Mission, number: int, key: str) -> ProductManifest | None:
    """The manifest of a key; None where there is none that can be read.

    Args:
        mission: of the exposure.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.
    """
    path = manifest_folder(mission, number) / f"{key}.json"
    try:
        return parse_manifest(path.read_bytes(), key)
    except OSError:
        return None


def parse_manifest(data: bytes, key: str) -> ProductManifest | None:
    """The manifest in the content of a file; None where it is damaged or of another key or format.

    Args:
        data: content of the file.
        key: SHA-256 of what the products are computed from.
    """
    try:
        content = parse_record(data, f"{key}.json")
        if content["format"] != _FORMAT:
            return None
        files = {
            _plain_file_name(name): ProductFile(_count(file["nbytes"]), str(file["sha256"]))
            for name, file in content["files"].items()
        }
        if REPORT_FILE not in files:
            return None
        found = ProductManifest(str(content["key"]), files, str(content["compared_sha256"]))
    except (RecordError, KeyError, TypeError, ValueError, AttributeError):
        return None
    return found if found.key == key else None


def _plain_file_name(name: str) -> str:
    if name in ("", ".", "..") or "/" in name or "\0" in name:
        raise ValueError(name)
    return name


def _count(value: object) -> int:
    if type(value) is not int or value < 0:
        raise TypeError(value)
    return value


def is_complete(mission: Mission, number: int, key: str) -> bool:
    """Whether the products of this key are there, by looking at them.

    Compared are the names and sizes of all files and the hash of the quality report, which is
    different in every computation. `product_problems` compares every byte.

    Args:
        mission: of the exposure.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.
    """
    manifest = read_manifest(mission, number, key) if key else None
    if manifest is None:
        return False
    folder = mission.level2(number)
    try:
        with os.scandir(folder) as entries:
            sizes = {
                entry.name: entry.stat(follow_symlinks=False).st_size
                for entry in entries
                if entry.is_file(follow_symlinks=False)
            }
        report = (folder / REPORT_FILE).read_bytes()
    except OSError:
        return False
    is_listed = sizes == {name: file.nbytes for name, file in manifest.files.items()}
    return is_listed and sha256_hex(report) == manifest.files[REPORT_FILE].sha256


def provenance_of(mission: Mission, number: int, key: str) -> dict[str, Any]:
    """Host, versions and duration of a computation; empty where they are not known.

    Args:
        mission: of the exposure.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.
    """
    path = manifest_folder(mission, number) / f"{key}.provenance.json"
    try:
        return parse_record(path.read_bytes(), path.name)
    except (OSError, RecordError):
        return {}


def duration_of(provenance: Mapping[str, Any]) -> float | None:
    """Duration of a computation in s; None where a sidecar has none that can be right.

    Args:
        provenance: content of a sidecar.
    """
    duration_s = provenance.get("duration_s")
    if isinstance(duration_s, bool) or not isinstance(duration_s, int | float):
        return None
    return duration_s if 0 <= duration_s <= _DURATION_MAX_S else None


@contextmanager
def claimed(mission: Mission, number: int) -> Iterator[None]:
    """Keep other processes from computing the same exposure until the block ends.

    The kernel's lock ends with its process, however that dies. A file system without locks
    permits two computations; the first manifest is the commit all the same.

    Raises:
        ClaimedElsewhereError: another process or thread computes it now.
        OSError: the disk refused.
    """
    folder = manifest_folder(mission, number)
    durable.make_directories(folder)
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        with suppress(OSError):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ClaimedElsewhereError(
                    f"exposure {number} is being computed by another process"
                ) from None
        yield
    finally:
        os.close(descriptor)


def publish(
    mission: Mission, number: int, key: str, contents: Mapping[str, Parts]
) -> ProductManifest:
    """Write products, give them their final name, and return their manifest, not yet committed.

    Manifests of other keys are removed before: their products are replaced. Call it in `claimed`.

    Args:
        mission: of the exposure.
        number: of the exposure.
        key: SHA-256 of what the products are computed from.
        contents: bytes by file name, with quality.json.

    Raises:
        OSError: the disk refused; an earlier product set is still there.
    """
    with closing(StagedFolder(mission.level2(number))) as staged, ThreadPoolExecutor(1) as hashing:
        hashes = {name: hashing.submit(parts_sha256, parts) for name, parts in contents.items()}
        sizes = level2.write_files(staged.part, contents)
        files = {name: ProductFile(sizes[name], hashes[name].result()) for name in sorted(sizes)}
        _revoke(mission, number)
        staged.publish()
    report = parse_record(b"".join(contents[REPORT_FILE]), REPORT_FILE)
    return manifest_of(key, files, report)


def manifest_of(
    key: str, files: Mapping[str, ProductFile], report: Mapping[str, Any]
) -> ProductManifest:
    """The manifest of written products.

    Args:
        key: SHA-256 of what the products are computed from.
        files: by name, with quality.json.
        report: content of quality.json.
    """
    return ProductManifest(key, files, _compared_sha256(files, report))


def commit(
    mission: Mission, number: int, manifest: ProductManifest, provenance: Mapping[str, Any]
) -> bool:
    """Commit published products: provenance first, the manifest last and at most once.

    Args:
        mission: of the exposure.
        number: of the exposure.
        manifest: as `publish` returned it.
        provenance: host, versions and duration.

    Returns:
        Whether this call committed; False where the key was committed already.

    Raises:
        OSError: the disk refused.
    """
    folder = manifest_folder(mission, number)
    path = folder / f"{manifest.key}.json"
    try:
        if path.exists():
            return False
        durable.replace_file(
            folder / f"{manifest.key}.provenance.json", canonical_bytes(dict(provenance))
        )
        with durable.new_file(path, replaces=False) as part:
            part.write_bytes(canonical_bytes(manifest.as_json()))
    except FileExistsError:
        return False
    return True


def product_problems(
    mission: Mission,
    number: int,
    key: str,
    step: Callable[[int], None] = lambda count: None,
) -> list[str]:
    """What of a committed product set is missing or was altered, one sentence each.

    A set that another process replaces meanwhile is compared with its next manifest.

    Args:
        mission: of the exposure.
        number: of the exposure.
        key: SHA-256 of what the products were computed from.
        step: called with the number of bytes read.
    """
    manifest = read_manifest(mission, number, key)
    while manifest is not None:
        problems = _differences(mission.level2(number), manifest, step)
        present = read_manifest(mission, number, key)
        if not problems or present == manifest:
            return problems
        manifest = present
    if (manifest_folder(mission, number) / f"{key}.json").exists():
        return [f"exposure {number}: the manifest of key {key[:12]} is damaged"]
    return [f"exposure {number}: no manifest of key {key[:12]}"]


def _differences(folder: Path, manifest: ProductManifest, step: Callable[[int], None]) -> list[str]:
    problems = []
    for name, file in manifest.files.items():
        where = f"{folder.parent.name}/{folder.name}/{name}"
        try:
            found = _regular_file_sha256(folder / name, step)
        except OSError as error:
            problems.append(f"{where}: cannot be read ({error.strerror})")
            continue
        if found != file.sha256:
            problems.append(f"{where}: differs from its manifest")
    return problems


def _regular_file_sha256(path: Path, step: Callable[[int], None]) -> str:
    """The hash of a plain file; links are not followed and pipes not waited for.

    Raises:
        OSError: it is missing, no plain file, or cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    digest = hashlib.sha256()
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "is no plain file")
        while block := os.read(descriptor, _BLOCK_BYTES):
            digest.update(block)
            step(len(block))
    finally:
        os.close(descriptor)
    return digest.hexdigest()


def committed_keys(mission: Mission, number: int) -> list[str]:
    """Keys with a manifest; there is at most one that the products agree with."""
    try:
        names = [path.stem for path in manifest_folder(mission, number).glob("*.json")]
    except OSError:
        return []
    return sorted(name for name in names if len(name) == _KEY_CHARACTERS)


def _revoke(mission: Mission, number: int) -> None:
    folder = manifest_folder(mission, number)
    found = list(folder.glob("*.json"))
    for path in found:
        path.unlink(missing_ok=True)
    if found:
        durable.sync_directory(folder)


def parts_sha256(parts: Parts) -> str:
    """SHA-256 of a file that is given in parts."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


def _compared_sha256(files: Mapping[str, ProductFile], report: Mapping[str, Any]) -> str:
    compared = {key: value for key, value in report.items() if key not in UNCOMPARED_KEYS}
    hashes = {name: file.sha256 for name, file in files.items()}
    hashes[REPORT_FILE] = sha256_hex(canonical_bytes(compared))
    return sha256_hex(canonical_bytes(hashes))
