"""Packages of npm that tests hold the product against; where one is not to be had they skip."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

PACK_TIMEOUT_S = 100


def npm_package(wanted: str, folder: Path) -> Path:
    """The unpacked content of a package such as `axe-core@4`, or a visible skip."""
    folder.mkdir(parents=True)
    if shutil.which("npm") is None:
        pytest.skip(f"{wanted} needs npm: apt-get install npm")
    try:
        packed = subprocess.run(
            ["npm", "pack", wanted, "--silent"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=PACK_TIMEOUT_S,
            check=True,
        )
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
        pytest.skip(f"{wanted} is not to be had from npm; a network is needed")
    subprocess.run(["tar", "xzf", packed.stdout.strip()], cwd=folder, check=True, timeout=60)
    return folder / "package"
