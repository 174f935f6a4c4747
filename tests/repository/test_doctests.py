"""The examples in docstrings run and give the results that they state."""

import subprocess
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[2]

EXAMPLES = {
    "processing/bundle": 9,
    "processing/calibration": 7,
    "processing/geometry": 54,
    "processing/mosaic": 7,
    "processing/radiometry": 17,
    "processing/rig": 5,
}
"""Functions with an example, by package. Raise the number with each new one: none may vanish."""


Run = subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Counter[str]]:
    """A run over all packages, and its passed examples by package."""
    report = tmp_path_factory.mktemp("doctests") / "report.xml"
    command = [sys.executable, "-m", "pytest", "--doctest-modules", "-o", "addopts=", "-q"]
    command += ["-p", "no:cacheprovider", f"--junitxml={report}", *EXAMPLES]
    run = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=110
    )
    passed: Counter[str] = Counter()
    if report.exists():
        for case in ElementTree.parse(report).iter("testcase"):
            if not len(case):
                passed["/".join(case.attrib["classname"].split(".")[:2])] += 1
    return run, passed


def test_every_example_gives_the_stated_result(outcome: tuple[Run, Counter[str]]) -> None:
    run = outcome[0]
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("package", EXAMPLES)
def test_no_example_vanished(package: str, outcome: tuple[Run, Counter[str]]) -> None:
    found = outcome[1][package]
    assert found >= EXAMPLES[package], f"{package} has {found} examples that pass"
