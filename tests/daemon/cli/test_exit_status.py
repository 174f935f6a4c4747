"""Exit statuses: one table, in the help pages, in the manual page and in the documents."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from daemon.cli import app
from daemon.cli.command_table import TABLE
from daemon.cli.exit_status import (
    JSON_OPTIONS,
    MEANINGS,
    PROBLEMS,
    ExitStatus,
    as_markdown,
    help_line,
    statuses_of,
)
from daemon.cli.man_page import leaf_commands, man_page

ROOT = Path(__file__).parents[3]
COMMANDS = dict(leaf_commands(get_command(app)))
ENDINGS = {"typer.Exit", "sys.exit"}


def endings(path: Path) -> Iterator[ast.expr]:
    """Arguments of `typer.Exit` and `sys.exit` in a module."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ENDINGS:
            yield from node.args
            yield from (keyword.value for keyword in node.keywords)


@pytest.mark.parametrize("path", sorted((ROOT / "daemon/cli").rglob("*.py")), ids=lambda p: p.name)
def test_no_command_ends_with_a_number_that_is_not_in_the_table(path: Path) -> None:
    for argument in endings(path):
        text = ast.unparse(argument)
        assert text.startswith(("ExitStatus", "status_of(", "STATUSES[", "main()")), text


def test_the_tables_name_every_status_and_every_command() -> None:
    assert set(MEANINGS) == set(ExitStatus)
    assert {name.partition(" ")[0] for name in PROBLEMS} == set(TABLE)
    for name in COMMANDS:
        statuses = statuses_of(name)
        assert set(statuses) == set(ExitStatus) - ({ExitStatus.WAITING} - {*_waiting(name)})


def _waiting(name: str) -> tuple[ExitStatus, ...]:
    return (ExitStatus.WAITING,) if name == "check" else ()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_prints_json_and_states_how_it_ends(name: str) -> None:
    command: Any = COMMANDS[name]
    options = {option for parameter in command.params for option in parameter.opts}
    assert JSON_OPTIONS.get(name, "--json") in {"", *options}
    assert command.epilog == help_line(name)


def test_the_help_page_of_a_command_ends_with_its_exit_statuses() -> None:
    done = CliRunner().invoke(app, ["verify", "--help"], env={"COLUMNS": "200"})
    assert "Exit status: 0 done; 1 a file is missing, altered or foreign; 2" in done.output


def test_the_document_has_the_tables() -> None:
    text = (ROOT / "docs/reference/exit-status.md").read_text("utf-8")
    assert text.endswith(as_markdown())


def test_the_manual_page_has_every_command_option_and_status(tmp_path: Path) -> None:
    page = man_page()
    for name, command in COMMANDS.items():
        assert f"\\fBsyntopic {name.replace('-', chr(92) + '-')}\\fP" in page
        for parameter in command.params:
            options = [option for option in parameter.opts if option.startswith("-")]
            assert all(option.replace("-", "\\-") in page for option in options)
    assert all(f"\\fB{status:d}\\fP" in page for status in ExitStatus)
    assert all(ord(character) < 0x80 for character in page)


def test_the_manual_page_is_formatted_without_a_warning(tmp_path: Path) -> None:
    if shutil.which("groff") is None:
        pytest.skip("groff is absent; install Debian's groff-base")
    path = tmp_path / "syntopic.1"
    path.write_text(man_page(), "utf-8")
    done = subprocess.run(
        ["groff", "-man", "-Tutf8", "-ww", str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stderr == ""
    text = re.sub(".\x08", "", done.stdout)  # bold is struck twice
    assert "EXIT STATUS" in text and "syntopic verify" in text
