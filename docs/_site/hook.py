"""Hook of MkDocs: adds the generated pages, links to files of the repository, and MathML."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any, Final

from docs._site import formulas, navigation
from docs._site.pages import generated_pages

ROOT: Final = Path(__file__).parents[2]
COPIED: Final = {
    "CONTRIBUTING.md": "reference/contributing/contributing.md",
    "CHANGELOG.md": "reference/contributing/changelog.md",
    "SECURITY.md": "reference/contributing/reporting.md",
    "benchmarks/README.md": "reference/results/benchmarks.md",
}
"""Pages outside docs/ that the site has as well."""

SCRIPTS: Final = {"assets/iframe-worker.js": "vendor/iframe-worker.js"}

_LINK: Final = re.compile(r"(!?)\[((?:[^\]\\]|\\.)*)\]\(([^)\s]+)\)")
_OPTIONS: Final = re.compile(r"^(```\w+) [^\n]+$", re.MULTILINE)
"""Options of a block for tests/repository/test_document_examples.py, which Markdown does not
know."""
_NAMED: Final = re.compile(r"(?<![\w/\[.`])(?<!\]\()docs/([\w/-]+\.md)((?:#[\w-]+)?)")


def on_config(config: Any) -> Any:
    """The navigation, from the pages that are there."""
    folder = Path(config["docs_dir"])
    own = (path.relative_to(folder).as_posix() for path in folder.rglob("*.md"))
    config["nav"] = navigation.navigation({*own, *generated_pages(), *COPIED.values()})
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add generated and copied pages, and scripts that Material would fetch from the network."""
    from mkdocs.structure.files import File

    for place, text in generated_pages().items():
        files.append(File.generated(config, place, content=with_links(text, place)))
    for source, place in COPIED.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / source)))
    for place, source in SCRIPTS.items():
        path = str(Path(__file__).parent / source)
        files.append(File.generated(config, place, abs_src_path=path))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to files outside docs/ lead to their copy on the site, or become their path.

    Options of code blocks are left out.
    """
    here = page.file.src_uri
    sources = {place: source for source, place in COPIED.items()}
    origin = sources.get(here, f"docs/{here}")

    def replaced(found: re.Match[str]) -> str:
        mark, text, target = found.groups()
        place, _, anchor = target.partition("#")
        if not place or re.match(r"[a-z]+:", target):
            return found[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(origin), place))
        inside = COPIED.get(path, path.removeprefix("docs/") if path.startswith("docs/") else None)
        if inside is None:
            return f"`{path}`" if mark else f"{text} (`{path}`)"
        relative = posixpath.relpath(inside, posixpath.dirname(here))
        return f"{mark}[{text}]({relative}{'#' if anchor else ''}{anchor})"

    markdown = _OPTIONS.sub(r"\1", markdown)
    parts = re.split(r"(^```.*?^```$|`[^`\n]+`)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(p if i % 2 else _LINK.sub(replaced, p) for i, p in enumerate(parts))


def on_page_content(html: str, **_: Any) -> str:
    """Formulas as MathML."""
    return formulas.with_mathml(html)


def with_links(text: str, here: str) -> str:
    """A page at `here` in which paths of pages, such as docs/index.md, are links."""

    def linked(found: re.Match[str]) -> str:
        relative = posixpath.relpath(found[1], posixpath.dirname(here))
        return f"[{Path(found[1]).stem}]({relative}{found[2]})"

    return _NAMED.sub(linked, text)
