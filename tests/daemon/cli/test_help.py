"""What `--help` says, of every command."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command

from daemon.cli import app


def commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    yield name, command
    for inner, below in getattr(command, "commands", {}).items():
        yield from commands(below, f"{name} {inner}")


ALL = dict(commands(get_command(app), "syntopic"))


@pytest.mark.parametrize("name", ALL)
def test_every_command_has_an_example_and_says_what_each_option_is(name: str) -> None:
    command = ALL[name]
    assert "`syntopic " in command.help
    assert "Example" in command.help
    assert [p.name for p in command.params if not (p.help or p.name == "help")] == []
