"""What decides the bytes of a product besides its inputs: code, libraries, CPU family."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Final

import daemon
import drivers
import processing

LIBRARIES: Final = ("llvmlite", "numba", "numpy", "opencv-python-headless", "pyproj", "scipy")
"""Distributions whose code computes pixels, figures or coordinates of products."""

_SOURCES: Final = (".py", ".toml")
_RELATED: Final = {
    daemon: ("configuration", "mission", "orientation", "planning", "products"),
    drivers: ("timescales",),
    processing: ("",),
}
"""Packages that products depend on."""


@functools.cache
def software_identity() -> dict[str, str]:
    """Versions of code and libraries and the CPU family, by name."""
    from llvmlite import binding

    features = ",".join(sorted(name for name, on in binding.get_host_cpu_features().items() if on))
    return {
        "software": version("syntopic"),
        "code_sha256": code_sha256(_RELATED),
        "python": platform.python_version(),
        "cpu": f"{binding.get_host_cpu_name()}-{hashlib.sha256(features.encode()).hexdigest()[:8]}",
        **{name: version(name) for name in LIBRARIES},
    }


def code_sha256(related: Mapping[ModuleType, Sequence[str]]) -> str:
    """SHA-256 over names and contents of source files.

    Args:
        related: folders of each package.
    """
    digest = hashlib.sha256()
    for package, folders in related.items():
        root = Path(str(package.__file__)).parent
        for folder in folders:
            for path in sorted((root / folder).rglob("*")):
                if path.suffix in _SOURCES:
                    digest.update(f"{root.name}/{path.relative_to(root)}\0".encode())
                    digest.update(path.read_bytes())
    return digest.hexdigest()
