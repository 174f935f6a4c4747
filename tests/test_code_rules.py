"""The house keeps its rules: names, imports, processes."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("daemon", "drivers", "processing", "sim_hw")


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
                    assert any("njit" in ast.unparse(d) for d in node.decorator_list), (
                        f"{path.relative_to(ROOT)}: {node.name} has no types and is no kernel"
                    )
