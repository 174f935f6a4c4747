"""The manual page syntopic(1), from the table of commands and their help texts.

`python -m daemon.cli.man_page FILE` writes it. `make wheel` puts it into the wheel.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from typer.main import get_command

from daemon.cli import app
from daemon.cli.command_table import TABLE
from daemon.cli.exit_status import MEANINGS, statuses_of

_FILES = {
    "/etc/syntopic/service.toml": "Configuration of the service.",
    "/etc/syntopic/tokens.toml": "Hashes of access tokens.",
    "/var/lib/syntopic": "Missions.",
    "/var/cache/syntopic": "Compiled kernels.",
    "/run/syntopic/control.sock": "Commands of `syntopic send`.",
}


def leaf_commands(command: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every command below one, with its full name such as "export raw"."""
    for inner, below in getattr(command, "commands", {}).items():
        full = f"{name} {inner}".strip()
        if getattr(below, "commands", None):
            yield from leaf_commands(below, full)
        else:
            yield full, below


def man_page() -> str:
    """The page in roff with the man macros."""
    lines = [
        f'.TH SYNTOPIC 1 "" "Syntopic {version("syntopic")}" "User Commands"',
        ".nh",
        ".SH NAME",
        r"syntopic \- onboard software of an aerial camera made of several heads",
        ".SH SYNOPSIS",
        r".B syntopic",
        r"\fICOMMAND\fP [\fIOPTIONS\fP] [\fIARGUMENTS\fP]",
        ".SH DESCRIPTION",
        *_paragraphs(
            "Syntopic captures exposures with several heads, stitches them in flight, and "
            "evaluates each image before the next trigger. With `--json` a command prints one JSON "
            "object; `run` prints one for each event with `--json-lines`. Begin with `syntopic "
            "demo`."
        ),
        ".SH COMMANDS",
    ]
    group = ""
    for name, command in leaf_commands(get_command(app)):
        entry = TABLE[name.partition(" ")[0]]
        if entry.group != group:
            group = entry.group
            lines += [f".SS {_text(group)}"]
        lines += _command(name, command)
    lines += [".SH EXIT STATUS"]
    for status, meaning in MEANINGS.items():
        lines += [".TP", rf"\fB{status:d}\fP", _text(meaning)]
    lines += [".SH FILES"]
    for path, purpose in _FILES.items():
        lines += [".TP", rf"\fI{_text(path)}\fP", _text(purpose)]
    lines += [".SH SEE ALSO", r"\fBsystemctl\fP(1), \fBjournalctl\fP(1)"]
    return "\n".join(lines) + "\n"


def _command(name: str, command: Any) -> list[str]:
    usage = [f"[{_metavar(p)}]" if not p.required else _metavar(p) for p in _arguments(command)]
    lines = [
        ".PP",
        rf"\fBsyntopic {_text(name)}\fP [\fIOPTIONS\fP] {_text(' '.join(usage))}".strip(),
    ]
    lines += [".RS", *_paragraphs(command.help or "")]
    for parameter in _arguments(command):
        lines += [".TP", rf"\fI{_text(_metavar(parameter))}\fP", _text(parameter.help or "")]
    for parameter in command.params:
        if parameter.param_type_name == "option" and not parameter.hidden:
            names = ", ".join((*parameter.opts, *parameter.secondary_opts))
            value = "" if parameter.is_flag else f" {_metavar(parameter)}"
            lines += [".TP", rf"\fB{_text(names)}\fP{_text(value)}", _text(parameter.help or "")]
    lines += [".TP", "Exit status"]
    listed = "; ".join(f"{status:d} {meaning}" for status, meaning in statuses_of(name).items())
    return [*lines, _text(f"{listed}."), ".RE"]


def _arguments(command: Any) -> list[Any]:
    return [p for p in command.params if p.param_type_name == "argument" and not p.hidden]


def _metavar(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name).upper()


def _paragraphs(text: str) -> Iterator[str]:
    """Paragraphs of a help text."""
    for number, paragraph in enumerate(re.split(r"\n\s*\n", text.strip())):
        if number:
            yield ".PP"
        yield _text(" ".join(paragraph.split()))


def _text(text: str) -> str:
    """A line of roff: code in bold, and no character with a meaning of its own."""
    text = text.replace("\\", r"\e").replace("-", r"\-").replace("'", r"\(aq")
    text = re.sub(r"`([^`]*)`", r"\\fB\1\\fP", text)
    text = re.sub(r"[^\x00-\x7f]", lambda match: rf"\[u{ord(match[0]):04X}]", text)
    return rf"\&{text}" if text.startswith(".") else text


def main() -> int:
    Path(sys.argv[1]).parent.mkdir(parents=True, exist_ok=True)
    Path(sys.argv[1]).write_text(man_page(), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
