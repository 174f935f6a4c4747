"""Rules of the code: names, imports, processes."""

from __future__ import annotations

import ast
import builtins
import re
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("daemon", "drivers", "processing", "sim_hw")
ERROR_ROOTS = {
    "daemon": "DaemonError",
    "drivers": "DriverError",
    "processing": "ProcessingError",
    "sim_hw": "SimulatorError",
}
"""Root of the exception classes of each package, in its `__init__.py`."""


@pytest.mark.parametrize("package", PACKAGES)
def test_no_other_distribution_provides_our_import_names(package: str) -> None:
    owners = set(packages_distributions().get(package, [])) - {"syntopic"}
    assert not owners, f"{package} also comes from {owners}; uninstall that in this environment"


@pytest.mark.parametrize(
    "module", ["daemon.onboard.service.service", "daemon.cli", "daemon.cli.run"]
)
def test_the_service_imports_neither_hardware_nor_kernels_nor_opencv(module: str) -> None:
    code = (
        f"import sys, {module}; print(sorted({{'gi', 'numba', 'cv2', 'scipy'}} & set(sys.modules)))"
    )
    completed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert completed.stdout.strip() == "[]"


def test_only_the_capture_side_of_the_drivers_imports_gi() -> None:
    importing = [
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        if re.search(r"^\s*(import gi\b|from gi\b)", path.read_text(), re.MULTILINE)
    ]
    assert importing
    assert all(path.startswith("drivers/cameras/aravis/") for path in importing), importing


def test_quantiles_come_from_scipy_special() -> None:
    """`scipy.stats` takes a third of a second of every process that imports it."""
    importing = [
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        if re.search(
            r"^\s*from scipy(\.stats| import stats)\b", path.read_text("utf-8"), re.MULTILINE
        )
    ]
    assert not importing, importing


@pytest.mark.parametrize(
    ("imported", "homes"),
    [
        (r"scipy\.spatial\.transform\b", {"processing/geometry/rotation.py"}),
        (r"pyproj\b", {"daemon/orientation/geodesy.py"}),
    ],
)
def test_rotations_and_geodesy_have_their_home(imported: str, homes: set[str]) -> None:
    """The emulator has its own, as it shares no mathematics with what it tests."""
    importing = {
        path.relative_to(ROOT).as_posix()
        for package in ("daemon", "drivers", "processing")
        for path in (ROOT / package).rglob("*.py")
        if re.search(rf"^\s*(import|from) {imported}", path.read_text("utf-8"), re.MULTILINE)
    }
    assert importing == homes


CONVERSIONS_OF_ROTATIONS = r"\bcv2\.(?:Rodrigues|RQDecomp3x3|decomposeProjectionMatrix)\b"


def test_no_other_library_converts_rotations() -> None:
    assert re.search(CONVERSIONS_OF_ROTATIONS, "turn = cv2.Rodrigues(rotation)[0]")
    found = [
        path.relative_to(ROOT).as_posix()
        for package in ("daemon", "drivers", "processing")
        for path in (ROOT / package).rglob("*.py")
        if re.search(CONVERSIONS_OF_ROTATIONS, path.read_text("utf-8"))
    ]
    assert found == []


def test_processes_are_spawned_never_forked() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            assert "os.fork(" not in text, path
            for context in re.findall(r"get_context\(([^)]*)\)", text):
                assert context == '"spawn"', path


def test_only_kernels_go_without_types() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef) and node.returns is None:
                    decorators = [ast.unparse(one) for one in node.decorator_list]
                    assert any("njit" in d or "compiled_kernel" in d for d in decorators), (
                        f"{path.relative_to(ROOT)}: {node.name} has no types and is no kernel"
                    )


def test_every_kernel_states_its_arithmetic() -> None:
    """What a kernel does not state, it inherits from whoever compiles it first."""
    found = 0
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            if not re.search(r"jit|vectorize", text):
                continue
            for node in ast.walk(ast.parse(text)):
                called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
                if called.rpartition(".")[2] in {"njit", "jit", "vectorize", "guvectorize"}:
                    found += 1
                    keywords = {one.arg for one in node.keywords}
                    assert "fastmath" in keywords, f"{path.relative_to(ROOT)}:{node.lineno}"
    assert found


def _class_bases(package: str) -> dict[str, tuple[str, ...]]:
    """Names of the base classes of every class of a package."""
    return {
        node.name: tuple(ast.unparse(base).rpartition(".")[2] for base in node.bases)
        for path in (ROOT / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    }


def _ancestors(name: str, bases: dict[str, tuple[str, ...]]) -> set[str]:
    """All direct and indirect base classes by name."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        new = set(bases.get(waiting.pop(), ())) - found
        found |= new
        waiting += new
    return found


@pytest.mark.parametrize(("package", "root"), ERROR_ROOTS.items())
def test_every_exception_class_of_a_package_derives_from_its_root(package: str, root: str) -> None:
    assert f"class {root}(Exception)" in (ROOT / package / "__init__.py").read_text()
    bases = _class_bases(package)
    built_in = {
        name
        for name, value in vars(builtins).items()
        if isinstance(value, type) and issubclass(value, BaseException)
    }
    own = [name for name in bases if _ancestors(name, bases) & built_in and name != root]
    assert own
    astray = [name for name in own if root not in _ancestors(name, bases)]
    assert not astray, f"{astray} of {package} do not derive from {root}"


def test_no_package_raises_a_bare_exception() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            found = re.search(r"raise (Base)?Exception\b", path.read_text())
            assert not found, f"{path.relative_to(ROOT)} raises Exception; raise an own class"


def test_every_ignored_type_error_has_its_reason_next_to_it() -> None:
    """A comment in the line before, or behind the mark."""
    bare = []
    for path in sorted(
        path
        for folder in (*PACKAGES, "benchmarks", "docs", "tests")
        for path in (ROOT / folder).rglob("*.py")
    ):
        lines = path.read_text("utf-8").splitlines()
        for before, line in zip(["", *lines], lines, strict=False):
            mark = re.search(r"# type: ignore\[[\w, -]+\](?P<reason>.*)", line)
            if mark and "#" not in mark["reason"] and "#" not in before:
                bare.append(f"{path.relative_to(ROOT)}: {line.strip()}")
    assert not bare, "\n".join(bare)
