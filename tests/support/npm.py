"""Packages of npm that tests use, pinned by version and hash in `npm.lock`.

`make test` installs them: `python -m tests.support.npm`. Nothing of them is part of the product.
"""

from __future__ import annotations

import base64
import hashlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import pytest

LOCK: Final = Path(__file__).with_suffix(".lock")
FOLDER: Final = Path(__file__).parents[2] / ".venv" / "npm"
PACK_TIMEOUT_S: Final = 300


class NpmError(Exception):
    """A package could not be installed; the message gives the reason."""


def pinned() -> Iterator[tuple[str, str]]:
    """Name with version, and integrity as npm writes it, of every package."""
    for line in LOCK.read_text("utf-8").splitlines():
        package, _, integrity = line.partition(" ")
        yield package, integrity


def npm_package(name: str) -> Path:
    """The content of a pinned package; a skip where it is not installed."""
    package = next(package for package, _ in pinned() if package.rpartition("@")[0] == name)
    folder = FOLDER / package
    if not folder.is_dir():
        pytest.skip(f"{package} is not installed; run: .venv/bin/python -m tests.support.npm")
    return folder


def install(package: str, integrity: str, folder: Path) -> None:
    """Download a package with npm, check its hash and unpack it into `folder`.

    Raises:
        NpmError: npm is absent or fails, or the package has another hash than the lock states.
    """
    if shutil.which("npm") is None:
        raise NpmError(f"{package} needs npm; run as root: apt-get install npm")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=FOLDER) as scratch:
        packed = subprocess.run(
            ["npm", "pack", package, "--silent"],
            cwd=scratch,
            capture_output=True,
            text=True,
            timeout=PACK_TIMEOUT_S,
            check=False,
        )
        if packed.returncode != 0:
            raise NpmError(f"npm pack {package} failed: {packed.stderr.strip()[-500:]}")
        (archive,) = Path(scratch).glob("*.tgz")
        digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
        if f"sha512-{digest}" != integrity:
            raise NpmError(f"{package} has the hash sha512-{digest}; npm.lock states {integrity}")
        subprocess.run(["tar", "xzf", archive], cwd=scratch, check=True, timeout=PACK_TIMEOUT_S)
        (Path(scratch) / "package").rename(folder)


def main() -> int:
    """Install what is missing; the exit status."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    try:
        for package, integrity in pinned():
            if not (FOLDER / package).is_dir():
                print(f"Installing {package} for the tests")
                install(package, integrity, FOLDER / package)
    except (NpmError, subprocess.TimeoutExpired) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
