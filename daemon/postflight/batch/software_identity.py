"""What decides the bytes of a product besides its inputs: code, libraries, CPU family."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Final

import daemon
import drivers
import processing

LIBRARIES: Final = (
    "llvmlite",
    "numba",
    "numpy",
    "opencv-python-headless",
    "pyproj",
    "rasterio",
    "scipy",
    "tifffile",
)
"""Distributions whose code computes pixels, figures or coordinates, or reads and writes files.

`rasterio`, which reads height models, may be missing.
"""

_SOURCES: Final = (".py", ".toml")
RELATED: Final = {
    daemon: (
        "__init__.py",
        "configuration",
        "mission",
        "orientation",
        "planning",
        "postflight/__init__.py",
        "postflight/batch/__init__.py",
        "postflight/batch/level2_work.py",
        "postflight/batch/product_key.py",
        "postflight/batch/software_identity.py",
        "postflight/batch/store_level2.py",
        "products",
    ),
    drivers: (
        "__init__.py",
        "base/__init__.py",
        "base/extras.py",
        "cameras/__init__.py",
        "cameras/tiff_layout.py",
        "contract.py",
        "timescales",
    ),
    processing: ("",),
}
"""Folders and files that decide the bytes of products, by package."""


@functools.cache
def software_identity() -> dict[str, str]:
    """Versions of code and libraries and the processor that kernels are compiled for, by name.

    That is this machine's, unless NUMBA_CPU_NAME or NUMBA_CPU_FEATURES states another.
    """
    from numba.core.registry import cpu_target

    from processing.image.kernel_cache import compiler_settings

    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    compiled = repr((features, compiler_settings()))
    return {
        "software": version("syntopic"),
        "code_sha256": code_sha256(RELATED),
        "python": platform.python_version(),
        "cpu": f"{processor}-{hashlib.sha256(compiled.encode()).hexdigest()[:8]}",
        **{name: _version(name) for name in LIBRARIES},
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def code_sha256(related: Mapping[ModuleType, Sequence[str]]) -> str:
    """SHA-256 over names and contents of source files.

    Args:
        related: folders and files of each package.
    """
    digest = hashlib.sha256()
    for package, folders in related.items():
        root = Path(str(package.__file__)).parent
        for folder in folders:
            place = root / folder
            for path in sorted(place.rglob("*")) if place.is_dir() else (place,):
                if path.suffix in _SOURCES:
                    digest.update(f"{root.name}/{path.relative_to(root)}\0".encode())
                    digest.update(path.read_bytes())
    return digest.hexdigest()
