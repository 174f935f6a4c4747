"""The key of a product covers all code and libraries that its computation imports."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from daemon.postflight.batch import software_identity
from daemon.postflight.batch.software_identity import LIBRARIES, RELATED, code_sha256
from tests.daemon.diverging_camera import ROOT

ROOTS = ("daemon.postflight.batch.level2_work", "daemon.postflight.batch.store_level2")
OWN = {package.__name__: package for package in RELATED}
DECIDE_NO_BYTES = {
    "daemon.postflight.batch.batch_run": "order and retries",
    "daemon.postflight.batch.capacity": "number of processes",
    "daemon.postflight.batch.control_groups": "number of processes",
    "daemon.postflight.batch.executor": "interface of executors",
    "daemon.postflight.batch.in_process": "threads of one process",
    "lz4": "flight logs, which no product is computed from",
    "mcap": "flight logs",
    "zstandard": "flight logs",
    "obstore": "transport; what arrives is compared with its hash",
    "pydantic": "checks settings, whose values are in the key",
    "pydantic-core": "checks settings",
}


def path_of(module: str) -> Path | None:
    path = ROOT / module.replace(".", "/")
    candidates = (path / "__init__.py", path.with_suffix(".py"))
    return next((one for one in candidates if one.exists()), None)


def imported(node: ast.AST) -> Iterator[str]:
    """Names of modules, also of imports within functions; not those for type checkers."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module:
            yield child.module
            yield from (f"{child.module}.{alias.name}" for alias in child.names)
        elif isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            yield from imported(ast.Module(child.orelse, []))
        else:
            yield from imported(child)


def closure() -> tuple[dict[str, Path], set[str]]:
    """Own modules with their files, and names of modules of libraries."""
    own: dict[str, Path] = {}
    libraries: set[str] = set()
    waiting = list(ROOTS)
    while waiting:
        module = waiting.pop()
        top = module.partition(".")[0]
        if top not in OWN:
            libraries.update({top} - sys.stdlib_module_names)
            continue
        path = path_of(module)
        if module in own or path is None:
            continue  # seen, or a name in a module
        own[module] = path
        waiting += [module.rpartition(".")[0]] if "." in module else []
        waiting += imported(ast.parse(path.read_text()))
    return own, libraries


def is_hashed(module: str, path: Path) -> bool:
    package = OWN[module.partition(".")[0]]
    root = Path(str(package.__file__)).parent
    return any(path.is_relative_to(root / place) for place in RELATED[package])


def test_the_key_covers_every_module_that_products_are_computed_with() -> None:
    own, _ = closure()
    assert len(own) > 150 and "drivers.cameras.tiff_layout" in own
    missing = {module for module, path in own.items() if not is_hashed(module, path)}
    assert missing == {name for name in DECIDE_NO_BYTES if name.startswith("daemon.")}


def test_the_key_covers_every_library_that_products_are_computed_with() -> None:
    _, modules = closure()
    names = packages_distributions()
    libraries = {names.get(module, [module])[0].replace("_", "-") for module in modules}
    assert {"tifffile", "rasterio"} <= libraries
    assert libraries - set(LIBRARIES) <= DECIDE_NO_BYTES.keys()
    assert set(LIBRARIES) <= libraries


def test_every_place_that_is_hashed_exists() -> None:
    for package, places in RELATED.items():
        root = Path(str(package.__file__)).parent
        assert [place for place in places if not (root / place).exists()] == []


def test_a_file_and_a_folder_are_hashed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pack/folder").mkdir(parents=True)
    for name in ("__init__.py", "one.py", "two.py", "folder/three.py"):
        (tmp_path / "pack" / name).write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    import pack  # type: ignore[import-not-found]  # written above

    related = {pack: ("one.py", "folder")}
    hashes = [code_sha256(related)]
    for name in ("one.py", "folder/three.py", "two.py"):
        (tmp_path / "pack" / name).write_text("x = 1")
        hashes.append(code_sha256(related))
    assert len(set(hashes)) == 3 and hashes[2] == hashes[3]


def test_a_library_that_is_not_installed_is_part_of_the_identity(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(software_identity, "LIBRARIES", ("numpy", "no-such-distribution"))
    found = software_identity.software_identity.__wrapped__()
    assert found["no-such-distribution"] == "none"


IDENTITY = """
from daemon.postflight.batch.software_identity import software_identity
print(software_identity()["cpu"])
"""


def test_the_processor_is_the_one_that_kernels_are_compiled_for() -> None:
    def cpu(**environment: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", IDENTITY],
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=110,
        )
        return done.stdout.strip()

    found = [
        cpu(),
        cpu(NUMBA_CPU_NAME="generic"),
        cpu(NUMBA_CPU_FEATURES="+sse2"),
        cpu(NUMBA_OPT="1"),
    ]
    assert len(set(found)) == len(found) and found[1].startswith("generic-")
