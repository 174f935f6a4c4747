"""The `--help` output of every command."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from daemon.cli import app, command_table, interrupt_messages
from daemon.cli.command_table import RENAMED, TABLE
from daemon.cli.exit_status import ExitStatus


def commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    yield name, command
    for inner, below in getattr(command, "commands", {}).items():
        yield from commands(below, f"{name} {inner}")


ALL = dict(commands(get_command(app), "syntopic"))


@pytest.mark.parametrize("name", ALL)
def test_every_command_has_an_example_and_describes_each_option(name: str) -> None:
    command = ALL[name]
    assert "`syntopic " in command.help
    assert "Example" in command.help
    assert [p.name for p in command.params if not (p.help or p.name == "help")] == []


LIGHT = {"typer", "click", "rich", "markdown_it", "mdurl", "pygments", "shellingham"}


def test_the_help_page_imports_no_command_and_no_heavy_library() -> None:
    code = (
        "import sys\n"
        "from daemon.cli import app\n"
        "sys.argv = ['syntopic', '--help']\n"
        "try:\n    app()\nexcept SystemExit:\n    pass\n"
        "roots = {m.partition('.')[0] for m in sys.modules} - set(sys.stdlib_module_names)\n"
        "print('ROOTS', sorted(roots))\n"
        "print('OURS', sorted(m for m in sys.modules if m.startswith('daemon.')))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    roots, ours = (line.partition(" ")[2] for line in done.stdout.splitlines()[-2:])
    allowed = LIGHT | {"daemon", "annotated_doc", "typing_extensions", "attr"}
    assert {r for r in ast.literal_eval(roots) if not r.startswith("_")} <= allowed
    assert ast.literal_eval(ours) == [
        "daemon.cli",
        "daemon.cli.command_table",
        "daemon.cli.exit_status",
        "daemon.cli.interrupt_messages",
    ]
    assert all(f" {name} " in done.stdout for name in TABLE)


@pytest.mark.parametrize(("former", "present"), RENAMED.items())
def test_a_former_name_is_refused_with_the_present_one(former: str, present: str) -> None:
    done = CliRunner().invoke(app, [former, "MISSION"])
    assert done.exit_code == 2
    assert f"Use '{present}'" in done.output


IMPERATIVES = """
    Adjust Bring Calibrate Check Compile Compute Copy Create Describe Detect Estimate
    Explain Export Find Fly Give Import Install Join Keep List Monitor Print Process Propose
    Read Remove Replay Revoke Run Send Stop Time Triangulate Validate Verify Write
"""


def test_summaries_are_imperative_sentences() -> None:
    for entry in TABLE.values():
        assert entry.summary.endswith(".") and len(entry.summary) <= 66
        assert entry.summary.split()[0].rstrip(",") in IMPERATIVES.split(), entry.summary


@pytest.mark.parametrize("name", [name for name in ALL if " " in name])
def test_the_help_of_every_command_begins_with_an_imperative_sentence(name: str) -> None:
    summary = ALL[name].help.partition("\n\n")[0]
    assert summary.split()[0] in IMPERATIVES.split(), summary
    assert summary.rstrip().endswith("."), summary


def test_the_version_is_that_of_the_distribution() -> None:
    done = CliRunner().invoke(app, ["--version"])
    assert done.output.strip() == f"syntopic {version('syntopic')}"


def test_an_interruption_while_a_command_is_imported_ends_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(_: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr(command_table, "load", interrupted)
    done = CliRunner().invoke(app, ["verify", "MISSION"])
    assert done.exit_code == ExitStatus.INTERRUPTED
    assert done.output.strip() == interrupt_messages.NOTHING_BEGUN
