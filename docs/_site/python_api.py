"""Pages of the Python packages `processing` and `drivers`; mkdocstrings reads their docstrings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from docs._site.tables import table

ROOT: Final = Path(__file__).parents[2]
PACKAGES: Final = ("processing", "drivers")


def pages() -> dict[str, str]:
    """Pages by their path below docs/: an index, and one page for each package with modules."""
    index = [
        "# Python",
        "",
        "Reference: the packages `processing` and `drivers`, from their docstrings.",
        "",
    ]
    written = {}
    for root in PACKAGES:
        rows = []
        for folder, modules in _packages(ROOT / root):
            name = ".".join(folder.relative_to(ROOT).parts)
            lines = [f"# {name}", "", f"Reference: the modules of `{name}`.", ""]
            for module in modules:
                lines += [f"## {module}", "", f"::: {name}.{module}", ""]
            place = f"{root}/{name.removeprefix(f'{root}.')}.md"
            written[f"reference/python/{place}"] = "\n".join(lines)
            rows.append((f"[`{name}`]({place})", ", ".join(f"`{one}`" for one in modules)))
        index += [f"## {root}", "", table(("package", "modules"), rows)]
    return {"reference/python/index.md": "\n".join(index), **written}


def _packages(root: Path) -> Iterator[tuple[Path, list[str]]]:
    """Folders with public modules, and the names of these."""
    for folder in (root, *sorted(path for path in root.rglob("*") if path.is_dir())):
        modules = sorted(p.stem for p in folder.glob("*.py") if not p.stem.startswith("_"))
        if modules:
            yield folder, modules
