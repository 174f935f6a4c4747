"""The key of a product: SHA-256 over everything that decides its bytes.

Inputs, calibration, settings, code, libraries and CPU family. Threads and the number of processes
are no part of it: the bytes do not depend on them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from daemon.mission.canonical_json import canonical_bytes, sha256_hex
from daemon.mission.store.level0_folder import CAPTURE_FILE, EXPOSURE_FILE, hash_file

RECORDS = (EXPOSURE_FILE, CAPTURE_FILE)


def input_identity(folder: Path, hash_of: Callable[[Path], str] = hash_file) -> dict[str, Any]:
    """Hashes of the records of an exposure, and of each file the size or the hash.

    A file whose hash is in the record is compared with it when it is read; its size stands for it
    here. Any other file is hashed.

    Args:
        folder: such as `L0/000001`.
        hash_of: SHA-256 of a file whose hash is not in a record.

    Raises:
        OSError: a file cannot be read.
        ValueError: the record is no JSON.
    """
    found: dict[str, Any] = {}
    hashed: set[str] = set()
    for name in RECORDS:
        path = folder / name
        if path.exists():
            data = path.read_bytes()
            found[name] = sha256_hex(data)
            hashed |= hashed_files(data)
    with os.scandir(folder) as entries:
        files = {e.name: e.stat().st_size for e in entries if e.is_file() and e.name not in RECORDS}
    for name, nbytes in sorted(files.items()):
        found[name] = nbytes if name in hashed else hash_of(folder / name)
    return found


def product_key(common: Mapping[str, Any], inputs: Mapping[str, Any], shares: Any) -> str:
    """The key of one exposure's products, 64 hexadecimal digits.

    Args:
        common: settings, calibration and software of the run.
        inputs: as `input_identity` returned them.
        shares: overlaps with other exposures, which enter the verdict; JSON types.
    """
    return sha256_hex(canonical_bytes({**common, "inputs": dict(inputs), "overlaps": shares}))


def tree_sha256(path: Path | None) -> str:
    """SHA-256 over names and contents of a file or folder; empty for None.

    Raises:
        OSError: it cannot be read.
    """
    if path is None:
        return ""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    hashes = {str(p.relative_to(path)) if path.is_dir() else "": hash_file(p) for p in files}
    return sha256_hex(canonical_bytes(hashes))


def frame_nbytes(inputs: Mapping[str, Any], folder: Path) -> int:
    """Bytes of an exposure's files that are read."""
    return sum(
        size if isinstance(size, int) else (folder / name).stat().st_size
        for name, size in inputs.items()
    )


def hashed_files(record: bytes) -> set[str]:
    """Names of the files whose hash a record has.

    Args:
        record: content of `exposure.json` or `capture.json`.

    Raises:
        ValueError: no JSON.
    """
    content = json.loads(record)
    frames = content.get("frames", []) if isinstance(content, dict) else []
    if not isinstance(frames, list):
        return set()
    return {
        str(frame.get("file") or f"{frame.get('sensor')}.tif")
        for frame in frames
        if isinstance(frame, dict) and frame.get("sha256")
    }
