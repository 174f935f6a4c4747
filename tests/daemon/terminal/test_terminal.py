"""Foreign text in a terminal and on a page is shown, never executed."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text
from rich.tree import Tree
from typer.testing import CliRunner

from daemon.cli import app
from daemon.terminal.console import Console, visible
from tests.daemon.planning.test_valid_coverage import line, mission_of

HOSTILE = (
    "[/x] [bold]b[/] \x1b]0;title\x07 \x1b[2J \x9b31m \u202egpj.exe\u200b :smile: [link=http://x]"
)


def printed(*renderables: object) -> str:
    file = io.StringIO()
    console = Console(file=file, width=200, force_terminal=True, color_system=None)
    for renderable in renderables:
        console.print(renderable)
    return file.getvalue()


@pytest.mark.trust
def test_markup_and_control_characters_are_shown_and_not_executed() -> None:
    table = Table("what", title=HOSTILE)
    table.add_row(HOSTILE)
    table.add_row(Text(HOSTILE))
    tree = Tree(HOSTILE)
    tree.add(HOSTILE)
    for renderable in (HOSTILE, Text(HOSTILE), table, tree):
        shown = printed(renderable)
        assert "[/x] [bold]b[/]" in shown and ":smile:" in shown and "[link=" in shown
        assert all(c.isprintable() or c == "\n" for c in shown), ascii(shown)


def test_printable_text_is_unchanged() -> None:
    for text in ("Überflug 7", "שדה", "道路", "a\tb\n"):
        assert visible(text) == text


@pytest.mark.trust
@pytest.mark.parametrize(
    "command", ["check", "process", "report", "rigs show", "reflights", "verify"]
)
def test_a_hostile_name_in_an_argument_ends_in_a_sentence(tmp_path: Path, command: str) -> None:
    done = CliRunner().invoke(app, [*command.split(), f"{tmp_path}/[/x]\x1b[2J.toml"])
    assert done.exit_code != 0
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        assert type(done.exception).__name__.endswith("Error"), repr(done.exception)
        assert type(done.exception).__module__.startswith(("daemon", "processing"))


@pytest.mark.trust
def test_a_mission_and_a_plan_with_markup_in_their_names_are_advised_on(tmp_path: Path) -> None:
    mission = mission_of(tmp_path / "[red] [blink]", line(dict.fromkeys(range(5, 8), ("SU00",))))
    plan = tmp_path / "[b].geojson"
    text = (mission / "plan.geojson").read_text()
    plan.write_text(text.replace('"id": "A"', '"id": "[/x] [blink]A"'))
    arguments = ["reflights", str(mission), "--plan", str(plan)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 1 and isinstance(done.exception, SystemExit), done.output
    assert "[/x]" in done.output and "[red]" in done.output
    output = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert output["segments"][0]["line"] == "[/x] [blink]A"
