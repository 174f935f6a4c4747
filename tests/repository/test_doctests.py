"""The examples in docstrings run and give the results that they state."""

import subprocess
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.timeout(310)  # compiles kernels where no cache of them is at hand
ROOT = Path(__file__).parents[2]

EXAMPLES = {
    "benchmarks": 2,
    "daemon/initialization": 1,
    "daemon/mission": 1,
    "daemon/onboard": 15,
    "daemon/orientation": 1,
    "daemon/planning": 4,
    "daemon/postflight": 3,
    "daemon/products": 1,
    "daemon/terminal": 2,
    "drivers/base": 4,
    "drivers/cameras": 17,
    "drivers/detection": 1,
    "drivers/receivers": 11,
    "drivers/thermometers": 5,
    "drivers/timescales": 3,
    "drivers/transport": 1,
    "processing/bundle": 23,
    "processing/calibration": 9,
    "processing/geometry": 64,
    "processing/image": 13,
    "processing/matching": 3,
    "processing/mosaic": 9,
    "processing/pipelines": 1,
    "processing/quality": 2,
    "processing/radiometry": 20,
    "processing/rig": 5,
    "sim_hw": 2,
    "tests/repository": 3,
}
"""Functions with an example, by package. Raise the number with each new one: none may vanish."""


Run = subprocess.CompletedProcess[str]


def package_of(module: str) -> str:
    """The package of a module in `EXAMPLES`, or the beginning of its path."""
    path = module.replace(".", "/")
    return next((p for p in EXAMPLES if path.startswith(f"{p}/")), path)


def files_with_examples() -> list[str]:
    """Files of Python that git tracks and that hold an example: others are not imported."""
    found = subprocess.run(
        ["git", "grep", "-lE", r"^\s*>>> ", "--", "*.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return found.stdout.split()


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Counter[str]]:
    """A run over all packages, and its passed examples by package."""
    report = tmp_path_factory.mktemp("doctests") / "report.xml"
    command = [sys.executable, "-m", "pytest", "--doctest-modules", "-o", "addopts=", "-q"]
    command += ["-p", "no:cacheprovider", f"--junitxml={report}", *files_with_examples()]
    run = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300
    )
    passed: Counter[str] = Counter()
    if report.exists():
        for case in ElementTree.parse(report).iter("testcase"):
            if not len(case):
                passed[package_of(case.attrib["classname"])] += 1
    return run, passed


def test_every_package_with_an_example_is_counted(outcome: tuple[Run, Counter[str]]) -> None:
    assert set(outcome[1]) == set(EXAMPLES)


def test_every_example_gives_the_stated_result(outcome: tuple[Run, Counter[str]]) -> None:
    run = outcome[0]
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("package", EXAMPLES)
def test_no_example_vanished(package: str, outcome: tuple[Run, Counter[str]]) -> None:
    found = outcome[1][package]
    assert found >= EXAMPLES[package], f"{package} has {found} examples that pass"
