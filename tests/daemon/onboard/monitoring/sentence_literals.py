"""The texts in the source of a module that may be sentences on the page.

Every text of some words counts, unless its place in the source shows that no operator reads it: a
docstring, a help text, a check of the configuration, a line of the log, a statement of SQL.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from daemon.onboard.monitoring.server_messages import message_of

ENGLISH = re.compile(r"[a-z]{3,} [a-z]{3,} [a-z]{3,}")
"""Of a parameter: words that stay English in every language."""
NAME, NUMBER = "SU11", "7"
"""What stands for a value. A number is right for every parameter."""
WHO = {"self._who": "SU11 at SU11", "who": "SU11 at SU11"}
"""Values that are a name and an address."""
FUNCTIONS = frozenset(("setting_conflicts",))
"""What they return refuses a configuration, before the page is served."""
ERRORS = frozenset(("SettingsError", "TypeError"))
"""Of a configuration, or of a caller."""
CALLS = frozenset(
    (
        *("Setting", "Query", "Path", "Header", "Field"),
        *("execute", "executemany"),
        *("debug", "info", "warning", "exception"),
    )
)
"""Help texts, SQL and lines of the log."""
KEYWORDS = frozenset(("help", "description"))


def sentences_of(source: Path, words_min: int) -> Iterator[list[str]]:
    """Each text of a module in variants: with a name, with a number and without optional parts.

    Args:
        source: the module.
        words_min: a shorter text is left out.
    """
    tree = ast.parse(source.read_text("utf-8"))
    left_out = _left_out(tree)
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            variants = [node.value]
        elif isinstance(node, ast.JoinedStr):
            variants = ["".join(_text(part, of) for part in node.values) for of in (NAME, NUMBER)]
            without = re.sub(r"(?<=[a-z])SU11|SU11(?=[a-z])", "", variants[0])
            variants += [without, without.replace(NAME, NUMBER)]
        else:
            continue
        if len(variants[0].split()) >= words_min:
            yield [_with_values(one) for one in variants]


def messages_of(variants: list[str]) -> Iterator[dict[str, Any]]:
    """The messages of a text in its variants, by itself and after the name of a device."""
    for one in variants:
        for text in (one, f"SU11: {one}", f"SU11 at SU11: {one}"):
            message = message_of(text)
            if message is not None and not ENGLISH.search(" | ".join(texts_of(message))):
                yield message


def codes_of(value: Any) -> Iterator[str]:
    """The codes of a message and of its parameters."""
    if isinstance(value, dict):
        yield value["code"]
        for one in value["parameters"].values():
            yield from codes_of(one)
    elif isinstance(value, list):
        for one in value:
            yield from codes_of(one)


def texts_of(value: Any) -> list[str]:
    """The texts of a message that are not of the catalog."""
    if isinstance(value, dict):
        return [text for one in value["parameters"].values() for text in texts_of(one)]
    if isinstance(value, list):
        return [text for one in value for text in texts_of(one)]
    return [value]


def _left_out(tree: ast.AST) -> set[int]:
    found: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            found |= {id(part) for part in node.values if isinstance(part, ast.Constant)}
        elif _is_no_sentence(node):
            found |= {id(part) for part in ast.walk(node)}
    return found


def _is_no_sentence(node: ast.AST) -> bool:
    match node:
        case ast.Expr(value=ast.Constant()) | ast.Assert():
            return True
        case ast.FunctionDef(name=name):
            return name in FUNCTIONS
        case ast.Raise(exc=ast.Call(func=function)):
            return ast.unparse(function) in ERRORS
        case ast.Call(func=function):
            return ast.unparse(function).rpartition(".")[2] in CALLS
        case ast.keyword(arg=name):
            return name in KEYWORDS
    return False


def _text(part: ast.expr, value: str) -> str:
    if isinstance(part, ast.Constant):
        return str(part.value)
    assert isinstance(part, ast.FormattedValue)
    if part.format_spec is not None and "%" in ast.unparse(part.format_spec):
        return "7%"
    return WHO.get(ast.unparse(part.value), value)


def _with_values(text: str) -> str:
    """A text with the fields of `str.format` filled."""
    text = re.sub(r"\{\w+:[^}]*%\}", "7%", text)
    return re.sub(r"\{\w+:[^}]*\}", "7", re.sub(r"\{\w+\}", "SU11", text))
