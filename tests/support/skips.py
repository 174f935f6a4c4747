"""Every skipped test by its reason, and whether `expected_skips.toml` allows that reason."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import pytest

EXPECTED: Final = Path(__file__).with_name("expected_skips.toml")
NEEDS: Final = ("hardware", "shared", "release")


def expected_reasons() -> dict[str, str]:
    """What a skip needs, by the regular expression of its reason."""
    listed = tomllib.loads(EXPECTED.read_text("utf-8"))["skip"]
    return {one["reason"]: one["needs"] for one in listed}


def need_of(reason: str, expected: Mapping[str, str]) -> str | None:
    """What the test needs that was skipped for this reason; None where the list has no such
    skip."""
    for pattern, need in expected.items():
        if re.fullmatch(pattern, reason, re.DOTALL):
            return need
    return None


def as_table(reasons: Iterable[str], expected: Mapping[str, str]) -> list[str]:
    """A line for each reason: what the tests need, how many they are, why they were skipped."""
    counts = Counter(reasons)
    rows = [
        (need_of(reason, expected) or "NOT LISTED", counts[reason], reason) for reason in counts
    ]
    return [f"{need:<10} {count:>4}  {reason}" for need, count, reason in sorted(rows)]


def reason_of(report: pytest.TestReport | pytest.CollectReport) -> str:
    """Why a test or a module was skipped."""
    details = report.longrepr
    text = details[2] if isinstance(details, tuple) else str(details)
    return text.removeprefix("Skipped: ").strip()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fail-on-skip",
        action="store_true",
        help="Fail if a test is skipped for a reason that expected_skips.toml does not list.",
    )


def _reasons(config: pytest.Config) -> list[str]:
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None:  # a worker of xdist
        return []
    return [reason_of(report) for report in reporter.stats.get("skipped", ())]


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail the run if a skip is not listed, and the caller asked for that."""
    if not session.config.getoption("--fail-on-skip"):
        return
    expected = expected_reasons()
    unlisted = [one for one in _reasons(session.config) if need_of(one, expected) is None]
    if unlisted and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Print the table of skips."""
    reasons = _reasons(config)
    if reasons:
        terminalreporter.section(f"{len(reasons)} skipped")
        for line in as_table(reasons, expected_reasons()):
            terminalreporter.write_line(line)
