"""The page of the papers' claims names files, tests, benchmarks and commands that are there."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path

import pytest
import typer

from daemon.cli import app

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/reference/results/papers.md").read_text(encoding="utf-8")
QUOTED = sorted(set(re.findall(r"`([^`\n]+)`", PAGE)))


def found(start: str) -> list[str]:
    return [text for text in QUOTED if text.startswith(start)]


@pytest.mark.parametrize("folder", ["processing/", "daemon/", "sim_hw/"])
def test_every_file_named_is_there(folder: str) -> None:
    named = found(folder)
    assert named
    assert [text for text in named if not list(ROOT.glob(text.rstrip("/")))] == []


def test_every_attribute_named_is_there() -> None:
    named = found("processing.")
    assert len(named) > 3
    for text in named:
        module, _, attribute = text.rpartition(".")
        if importlib.util.find_spec(text.split(".")[0]) and _is_module(text):
            continue
        assert hasattr(importlib.import_module(module), attribute), text


def _is_module(name: str) -> bool:
    return importlib.util.find_spec(name.rpartition(".")[0]) is not None and (
        (ROOT / name.replace(".", "/")).is_dir() or (ROOT / f"{name.replace('.', '/')}.py").exists()
    )


def test_every_test_named_is_there() -> None:
    commands = found("pytest ")
    assert len(commands) > 5
    for command in commands:
        arguments = shlex.split(command)[1:]
        chosen = arguments[arguments.index("-k") + 1] if "-k" in arguments else ""
        files = [ROOT / argument for argument in arguments if argument.startswith("tests/")]
        assert files and all(path.is_file() for path in files), command
        assert any(f"{chosen}" in path.read_text(encoding="utf-8") for path in files), command


def test_every_benchmark_named_is_there_and_knows_its_options() -> None:
    commands = found("python -m ")
    assert len(commands) > 5
    for command in commands:
        arguments = shlex.split(command)
        path = ROOT / f"{arguments[2].replace('.', '/')}.py"
        assert path.is_file(), command
        text = path.read_text(encoding="utf-8")
        assert [w for w in arguments[3:] if w.startswith("--") and f'"{w}"' not in text] == [], (
            command
        )


def test_every_command_named_is_there_and_knows_its_options() -> None:
    commands = found("syntopic ")
    assert len(commands) > 15
    for text in commands:
        known = typer.main.get_command(app)
        for argument in shlex.split(text)[1:]:
            inner = getattr(known, "commands", None)
            if inner is not None:
                assert argument in inner, text
                known = inner[argument]
            elif argument.startswith("--"):
                assert argument in {o for p in known.params for o in p.opts}, text
