"""Sections missing from docstrings of public functions.

Run: `python -m tests.repository.docstrings processing`.

A function with parameters has `Args` with each of them, one that returns a value `Returns` (or
`Yields`), one that raises `Raises` with each class. Properties need a summary only. A method that
overrides one of a base class inherits its docstring.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

Function = ast.FunctionDef | ast.AsyncFunctionDef
ROOT = Path(__file__).parents[2]
SECTION = re.compile(r"^(Args|Returns|Yields|Raises|Source|Examples?|Notes?):\s*(.*)$")
PROPERTIES = {"property", "cached_property"}


@dataclass(frozen=True)
class Class:
    """A class of a package: names of its bases and of its methods."""

    bases: tuple[str, ...]
    methods: frozenset[str]


def sections(docstring: str) -> dict[str, str]:
    """Text of each section of a docstring by its title."""
    found: dict[str, str] = {}
    title = ""
    for line in docstring.splitlines():
        match = SECTION.match(line)
        if match:
            title = match[1]
            found[title] = match[2]
        elif title:
            found[title] += "\n" + line
    return found


def parameters(function: Function, *, is_method: bool) -> list[str]:
    """Names of the parameters, without the instance or class."""
    arguments = function.args
    names = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args)]
    if is_method and "staticmethod" not in decorators(function):
        names = names[1:]
    names += [argument.arg for argument in arguments.kwonlyargs]
    names += [argument.arg for argument in (arguments.vararg, arguments.kwarg) if argument]
    return [name for name in names if not name.startswith("_")]


def decorators(function: Function) -> set[str]:
    found = set()
    for decorator in function.decorator_list:
        node = decorator.func if isinstance(decorator, ast.Call) else decorator
        found.add(node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", ""))
    return found


def own_nodes(function: Function) -> Iterator[ast.AST]:
    """Nodes of the function without those of functions inside it."""
    waiting: list[ast.AST] = list(function.body)
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            waiting += ast.iter_child_nodes(node)


def raised(function: Function) -> set[str]:
    """Names of the classes of exceptions that the function itself creates and raises."""
    found = set()
    for node in own_nodes(function):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            made = node.exc.func
            name = made.attr if isinstance(made, ast.Attribute) else getattr(made, "id", "")
            if name[:1].isupper() and name not in ("AssertionError", "NotImplementedError"):
                found.add(name)
    return found


def missing_sections(function: Function, *, is_method: bool = False) -> list[str]:
    """Sections that the docstring of a function does not have."""
    docstring = ast.get_docstring(function)
    if docstring is None:
        return ["a docstring"]
    if decorators(function) & PROPERTIES or "setter" in decorators(function):
        return []
    found = sections(docstring)
    described = found.get("Args", "")
    absent = [
        f"Args: {name}"
        for name in parameters(function, is_method=is_method)
        if not re.search(rf"^\s*\*{{0,2}}{name}\b.*:", described, re.MULTILINE)
    ]
    returns = function.returns
    has_value = returns is not None and ast.unparse(returns) not in ("None", "NoReturn", "Never")
    if has_value and not ({"Returns", "Yields"} & set(found)):
        absent.append("Returns")
    errors = found.get("Raises", "")
    absent += [
        f"Raises: {name}"
        for name in sorted(raised(function))
        if not re.search(rf"\b{name}\b", errors)
    ]
    return absent


@cache
def classes(package: Path) -> dict[str, Class]:
    """Classes of a package by name."""
    found: dict[str, Class] = {}
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                bases = [
                    base.value if isinstance(base, ast.Subscript) else base for base in node.bases
                ]
                found[node.name] = Class(
                    tuple(getattr(base, "attr", getattr(base, "id", "")) for base in bases),
                    frozenset(
                        item.name
                        for item in node.body
                        if isinstance(item, (ast.FunctionDef, ast.AsyncFunctionDef))
                    ),
                )
    return found


def is_inherited(method: str, bases: tuple[str, ...], known: dict[str, Class]) -> bool:
    """Whether a base class has the method, and so its description."""
    return any(
        base in known
        and (method in known[base].methods or is_inherited(method, known[base].bases, known))
        for base in bases
    )


def incomplete(package: Path, top: Path) -> Iterator[tuple[Path, int, str, list[str]]]:
    """Path, line, name and absent sections of each public function below `package`."""
    known = classes(top)
    paths = [package] if package.is_file() else sorted(package.rglob("*.py"))
    for path in paths:
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                if not node.name.startswith("_") and (absent := missing_sections(node)):
                    yield path, node.lineno, node.name, absent
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                bases = known[node.name].bases
                for item in node.body:
                    if (
                        isinstance(item, (ast.FunctionDef, ast.AsyncFunctionDef))
                        and not item.name.startswith("_")
                        and not is_inherited(item.name, bases, known)
                        and (absent := missing_sections(item, is_method=True))
                    ):
                        yield path, item.lineno, f"{node.name}.{item.name}", absent


def main() -> int:
    """Print what is missing below the paths given."""
    count = 0
    for argument in sys.argv[1:]:
        package = (ROOT / argument).resolve()
        top = ROOT / package.relative_to(ROOT).parts[0]
        for path, line, name, absent in incomplete(package, top):
            count += 1
            print(f"{path.relative_to(ROOT)}:{line} {name}: {', '.join(absent)}")
    print(f"{count} incomplete docstrings")
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
