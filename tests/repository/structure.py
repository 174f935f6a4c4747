"""Counts of the structure of revisions: `python -m tests.repository.structure HEAD [REVISION ...]`.

Words to avoid, entries of the packages' first level, small files, long signatures, classes of the
same name, docstrings, lines. Of a revision what git holds is counted, not the work tree.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Final

from tests.repository.docstrings import (
    Function,
    is_inherited,
    own_nodes,
    parameters,
    raised,
    sections,
)
from tests.repository.docstrings import classes as classes_of
from tests.repository.vocabulary import INSTEAD, PART, SUFFIXES, WORD

ROOT: Final = Path(__file__).parents[2]
PACKAGES: Final = ("daemon", "drivers", "processing", "sim_hw")
DOCUMENTED: Final = ("processing", "drivers")
SMALL_LINES: Final = 50
PARAMETERS_MAX: Final = 12
GIT_TIMEOUT_S: Final = 60


def structure(root: Path) -> dict[str, float]:
    """Counts by their names of the tree below `root`."""
    trees = {
        path: ast.parse(path.read_text("utf-8"))
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
    }
    lines = {path: len(path.read_text("utf-8").splitlines()) for path in trees}
    names = Counter(
        node.name
        for tree in trees.values()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    found: dict[str, float] = {
        "words to avoid": sum(1 for _ in words_to_avoid(root)),
        "public classes with the name of another": sum(1 for n in names.values() if n > 1),
    }
    for package in (*PACKAGES, "tests"):
        found[f"entries of {package}/"] = sum(
            1
            for entry in (root / package).iterdir()
            if not entry.name.startswith("_")
            and (entry.suffix == ".py" or (entry.is_dir() and any(entry.glob("**/*.py"))))
        )
    found[f"files under {SMALL_LINES} lines"] = sum(
        1 for path, count in lines.items() if count < SMALL_LINES and path.name[0] != "_"
    )
    found[f"functions of more than {PARAMETERS_MAX} parameters"] = sum(
        1
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and len(parameters(node, is_method=False)) > PARAMETERS_MAX
    )
    found["lines of Python"] = sum(lines.values())
    return found | docstring_shares(root, trees)


def words_to_avoid(root: Path) -> Iterator[str]:
    """Words to avoid in texts and code, those of the list itself and of the glossary left out."""
    for path in sorted(root.rglob("*")):
        if (
            path.is_file()
            and path.suffix in SUFFIXES
            and "vendor" not in path.parts
            and path.name not in ("vocabulary.py", "glossary.md", "CHANGELOG.md")
        ):
            for name in WORD.findall(path.read_text("utf-8")):
                yield from (part for part in PART.findall(name) if part.lower() in INSTEAD)


def docstring_shares(root: Path, trees: Mapping[Path, ast.Module]) -> dict[str, float]:
    """Percent of public functions that need a section and have it."""
    needed: Counter[str] = Counter()
    present: Counter[str] = Counter()
    for package in DOCUMENTED:
        known = classes_of(root / package)
        for path, tree in trees.items():
            if path.is_relative_to(root / package):
                for function, is_method, bases in public_functions(tree):
                    if is_inherited(function.name, bases, known):
                        continue
                    found = sections(ast.get_docstring(function) or "")
                    for title, is_needed in needs(function, is_method=is_method).items():
                        needed[title] += is_needed
                        present[title] += is_needed and title in found
                    present["Source"] += "Source" in found
    shares = {
        f"docstrings with {title}, percent": round(
            100.0 * present[title] / max(needed[title], 1), 1
        )
        for title in ("Args", "Returns", "Raises")
    }
    return shares | {"docstrings with Source": present["Source"]}


def public_functions(tree: ast.Module) -> Iterator[tuple[Function, bool, tuple[str, ...]]]:
    """Public functions and methods of a module, which are methods, and the bases of their class."""
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.name[0] != "_":
            yield node, False, ()
        elif isinstance(node, ast.ClassDef) and node.name[0] != "_":
            bases = tuple(getattr(base, "attr", getattr(base, "id", "")) for base in node.bases)
            for item in node.body:
                if isinstance(item, (ast.FunctionDef, ast.AsyncFunctionDef)):
                    is_property = any("property" in ast.unparse(d) for d in item.decorator_list)
                    if item.name[0] != "_" and not is_property:
                        yield item, True, bases


def needs(function: Function, *, is_method: bool) -> dict[str, bool]:
    """Which sections the docstring of a function should have."""
    returns = ast.unparse(function.returns) if function.returns is not None else "None"
    has_yield = any(isinstance(node, (ast.Yield, ast.YieldFrom)) for node in own_nodes(function))
    return {
        "Args": bool(parameters(function, is_method=is_method)),
        "Returns": returns not in ("None", "NoReturn", "Never") and not has_yield,
        "Raises": bool(raised(function)),
    }


def at(revision: str) -> dict[str, float]:
    """Counts of the files that git holds of a revision."""
    archive = subprocess.run(
        ["git", "archive", revision],
        cwd=ROOT,
        capture_output=True,
        check=True,
        timeout=GIT_TIMEOUT_S,
    ).stdout
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=BytesIO(archive)) as tar:
            tar.extractall(folder, filter="data")
        return structure(Path(folder))


def main() -> int:
    """Print a table, or one JSON object, of the revisions given."""
    parser = argparse.ArgumentParser(prog="python -m tests.repository.structure")
    parser.add_argument("revision", nargs="+")
    parser.add_argument("--json", action="store_true", help="Print one JSON object.")
    given = parser.parse_args()
    found = {revision: at(revision) for revision in given.revision}
    if given.json:
        print(json.dumps(found, indent=1))
        return 0
    print("| count | " + " | ".join(found) + " |")
    print("|---|" + "---|" * len(found))
    for name in next(iter(found.values())):
        cells = (re.sub(r"\.0$", "", f"{counts[name]:,}") for counts in found.values())
        print(f"| {name} | " + " | ".join(cells) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
