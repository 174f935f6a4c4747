"""The page of tested releases: how its cells are written."""

from __future__ import annotations

from tests.installed.release_check import Result, summary_of, with_results

HEAD = "# T\n\n| release | Python | `make demo` | `make test` |\n|---|---|---|---|\n"


def test_a_command_that_ran_replaces_its_cell_and_no_other() -> None:
    page = with_results(HEAD, "Debian 13", "3.13", {"demo": "passed"})
    page = with_results(page, "Debian 12", "3.11", {"demo": "passed", "test": "failed"})
    page = with_results(page, "Debian 13", "3.13", {"test": "passed in 9 min"})
    assert page == HEAD + (
        "| Debian 12 | 3.11 | passed | failed |\n"
        "| Debian 13 | 3.13 | passed | passed in 9 min |\n"
    )  # fmt: skip
    assert "| Debian 13 | 3.13 | passed | not run |" in with_results(
        HEAD, "Debian 13", "3.13", {"demo": "passed"}
    )


def test_the_count_of_tests_is_read_from_the_last_line_of_pytest() -> None:
    text = (
        "2 failed, 3 passed in 1.00s\nx\n== 1 failed, 20 passed, 3 skipped in 61.00s (0:01:01) ==\n"
    )
    assert summary_of(text) == "1 failed, 20 passed, 3 skipped"
    assert summary_of("make: nothing to be done") == ""


def test_a_result_is_a_sentence() -> None:
    assert str(Result(0, 960.0, "")) == "passed in 16 min"
    assert str(Result(2, 60.0, "1 failed")) == "failed (exit status 2) in 1 min: 1 failed"
