"""Pages of the commands, from the table of commands and the options that each declares."""

from __future__ import annotations

import enum
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final, get_args

from docs._site.tables import table

EXIT_STATUSES: Final = (
    "[Exit status and JSON](../exit-status.md) lists how each command ends, and how programs read "
    "its figures.\n"
)


def pages() -> dict[str, str]:
    """Pages by their path below docs/: an index, and one page for each group of commands."""
    from typer.main import get_command

    from daemon.cli import app
    from daemon.cli.command_table import TABLE

    commands: Mapping[str, Any] = vars(get_command(app))["commands"]
    groups: dict[str, list[str]] = {}
    for name, entry in TABLE.items():
        groups.setdefault(entry.group, []).append(name)
    index = ["# Commands", "", "Reference: every command of `syntopic`.", "", EXIT_STATUSES]
    written = {}
    for group, names in groups.items():
        place = re.sub(r"\W+", "-", group.lower())
        rows = [(f"[`{n}`]({place}.md#syntopic-{n})", TABLE[n].summary) for n in names]
        index += [f"## {group}", "", table(("command", "task"), rows)]
        lines = [f"# {group}", "", f"Reference: commands, {group.lower()}.", ""]
        for name in names:
            for full, command in _with_subcommands(f"syntopic {name}", commands[name]):
                lines += _section(full, command)
        written[f"reference/commands/{place}.md"] = "\n".join(lines)
    return {"reference/commands/index.md": "\n".join(index), **written}


def _with_subcommands(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    yield name, command
    for inner, below in getattr(command, "commands", {}).items():
        yield from _with_subcommands(f"{name} {inner}", below)


def _section(name: str, command: Any) -> list[str]:
    arguments = [p for p in command.params if p.name != "help" and not _is_option(p)]
    options = [p for p in command.params if _is_option(p) and p.name != "help"]
    usage = [name, *(_metavar(p) for p in arguments), *(["[OPTIONS]"] if options else [])]
    if getattr(command, "commands", None):
        usage.append("COMMAND")
    lines = [f"{'##' if name.count(' ') == 1 else '###'} {name}", "", f"    {' '.join(usage)}", ""]
    lines += [str(command.help or "").strip(), ""]
    if arguments:
        rows = [(f"`{p.name.upper()}`", _kind(p), _escaped(p.help or "")) for p in arguments]
        lines += [table(("argument", "type", "meaning"), rows)]
    if options:
        found = [
            (
                ", ".join(f"`{o}`" for o in (*p.opts, *p.secondary_opts)),
                _kind(p),
                _default(p),
                _escaped(p.help or ""),
            )
            for p in options
        ]
        lines += [table(("option", "type", "default", "meaning"), found)]
    return [*lines, *([str(command.epilog), ""] if command.epilog else [])]


def _escaped(text: str) -> str:
    """A help text in which brackets are no links of Markdown."""
    return text.replace("[", r"\[")


def _is_option(parameter: Any) -> bool:
    return bool(parameter.opts[0].startswith("-"))


def _metavar(parameter: Any) -> str:
    name = str(parameter.metavar or parameter.name.upper())
    name += "..." if parameter.nargs == -1 and not name.endswith("...") else ""
    return name if parameter.required else f"[{name}]"


def _kind(parameter: Any) -> str:
    """The type of a parameter with its limits, such as "integer, at least 1"."""
    annotation = parameter.type_descriptor.annotation
    inner = [one for one in get_args(annotation) if one is not type(None)] or [annotation]
    kind = inner[0]
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        text = ", ".join(f"`{one.value}`" for one in kind)
    else:
        names = {"str": "text", "int": "integer", "float": "number", "bool": "flag", "Path": "path"}
        named = getattr(kind, "__name__", str(kind))
        text = names.get(named, ", ".join(f"`{one}`" for one in inner))
    if parameter.min is not None:
        text += f", at least {parameter.min:g}"
    if parameter.max is not None:
        text += f", at most {parameter.max:g}"
    return f"{text}; repeatable" if parameter.multiple else text


def _default(parameter: Any) -> str:
    value = parameter.default
    if parameter.required:
        return "required"
    if value is None or value in ("", (), []):
        return ""
    if isinstance(value, bool):
        return f"`{parameter.opts[0]}`" if value else ""
    return f"`{value.value if isinstance(value, enum.Enum) else value}`"
