"""Every reference leads somewhere: pages, sections, figures, and works cited by author and year."""

from __future__ import annotations

import os
import re
import subprocess
import unicodedata
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

import pytest

from docs._site.pages import generated_pages

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = ROOT / "docs"
REFERENCES: Final = ROOT / "docs/reference/references.md"
MATHEMATICS: Final = ROOT / "docs/explanation/mathematics"
READ: Final = {".py", ".md", ".toml", ".html", ".js", ".css", ".sh", ".service", ".rules", ".txt"}
OURSELVES: Final = Path(__file__).relative_to(ROOT).as_posix()

LINK: Final = re.compile(r"\[[^\]\n]*(?:\n[^\]\n]*)?\]\(([^)\s]+)\)")
PAGE: Final = re.compile(r"(?<![\w/.-])(docs/[\w/.-]+\.md)((?:(?:,| and)? ?#[\w-]+)*)")
"""A page, and any number of its sections: "docs/a.md#one, #two and #three"."""
NOWHERE: Final = re.compile(
    r"\bDESIGN\b|(?<![\w-])seeds/|(?<![\w-])shared/|\b[Pp]romise \d"
    r"|\bthe (?:UltraCam(?: L)?|MIDAS|DMC) paper\b"
)
DATA: Final = re.compile(r"\.\./shared/data/")
EQUATION: Final = re.compile(r"\b[Ee]q\.\s(?:#\s)?\d")
NAME: Final = r"[A-ZÄÖÜ][\w'-]+"
CITED: Final = re.compile(rf"({NAME}(?: et al\.| and {NAME})?|EMVA) \((1[89]\d\d|20\d\d)[a-z]?\)")
BARE: Final = re.compile(r"\b(Ladst[äa]e?dter|Heier|Jacobsen|Fraser|Meissl|Baarda) (?:19|20)\d\d\b")
ENTRY: Final = re.compile(r"^- \*\*(.+?) \((\d{4})\)\*\*", re.MULTILINE)


def tracked() -> Iterator[tuple[str, str]]:
    """Path and text of every text file of the repository."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=True, timeout=60,
    ).stdout  # fmt: skip
    for name in filter(None, listed.split("\0")):
        path = ROOT / name
        is_read = path.suffix in READ or path.name == "Makefile"
        if is_read and path.is_file() and name != OURSELVES and "/vendor/" not in name:
            yield name, path.read_text(encoding="utf-8", errors="replace")


@cache
def texts() -> tuple[tuple[str, str], ...]:
    if not (ROOT / ".git").exists():
        pytest.skip("no repository: which files belong to it is not known")
    return tuple(tracked())


def pages() -> list[tuple[str, str]]:
    return [(name, text) for name, text in texts() if name.endswith(".md")]


def without_code(text: str) -> str:
    return re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.MULTILINE | re.DOTALL)


def headings(text: str) -> list[str]:
    found = re.findall(r"^#{1,6} +(.+?) *#*$", without_code(text), re.MULTILINE)
    return [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "") for heading in found]


def anchors(text: str) -> set[str]:
    """Anchors that both MkDocs and forges give to the headings of a page."""
    site, forge = set(), set()
    for heading in headings(text):
        plain = unicodedata.normalize("NFKD", heading).encode("ascii", "ignore").decode()
        bare = re.sub(r"[^\w\s-]", "", plain).strip().lower()
        site.add(re.sub(r"[-\s]+", "-", bare))
        forge.add(re.sub(r"[^\w\s-]", "", heading).strip().lower().replace(" ", "-"))
    return site & forge


@cache
def anchors_of(page: Path) -> set[str]:
    return anchors(page.read_text("utf-8"))


def problem_of(target: Path, anchor: str) -> str | None:
    """What is wrong with a reference to a page and a section of it; None if nothing is."""
    generated = generated_pages().get(os.path.relpath(target, DOCS))
    if generated is not None:
        is_there = not anchor or anchor in anchors(generated)
        return None if is_there else "the generated page has no such section"
    if not target.exists():
        return "there is no such file"
    if anchor and target.suffix == ".md" and anchor not in anchors_of(target):
        return "the page has no such section"
    return None


def test_every_link_of_a_page_leads_to_a_file_and_a_section() -> None:
    wrong = []
    for name, text in pages():
        for link in LINK.findall(without_code(text)):
            if re.match(r"[a-z]+:", link) or link.startswith("$"):
                continue
            place, _, anchor = link.partition("#")
            target = (ROOT / name).parent / place if place else ROOT / name
            problem = problem_of(target, anchor)
            if problem:
                wrong.append(f"{name}: {link}: {problem}")
    assert wrong == []


def test_every_page_named_in_code_is_there_with_its_section() -> None:
    wrong, named = [], 0
    for name, text in texts():
        flat = re.sub(r"\s+(?:# )?", " ", text)
        for place, sections in PAGE.findall(flat):
            named += 1
            for anchor in re.findall(r"#([\w-]+)", sections) or [""]:
                problem = problem_of(ROOT / place, anchor)
                if problem:
                    wrong.append(f"{name}: {place}#{anchor}: {problem}")
    assert named > 50
    assert wrong == []


def test_nothing_refers_to_documents_that_readers_do_not_have() -> None:
    wrong = []
    for name, text in texts():
        # Tests may read recorded data next to the checkout if they skip without it.
        reads_data = name.startswith("tests/") and "skip" in text
        searched = DATA.sub("", text) if reads_data else text
        wrong += [f"{name}: {found}" for found in NOWHERE.findall(searched)]
    assert wrong == []


@cache
def own() -> list[tuple[str, str]]:
    """Files of our own writing, on one line each; recorded data and its licences are not."""
    return [
        (name, re.sub(r"\s+(?:#\s+)?", " ", text))
        for name, text in texts()
        if "/data/" not in name and name != "docs/reference/references.md"
    ]


@cache
def cited_in() -> dict[str, set[str]]:
    """Works cited, by file."""
    return {name: {f"{who} ({year})" for who, year in CITED.findall(flat)} for name, flat in own()}


def entries() -> set[str]:
    return {f"{who} ({year})" for who, year in ENTRY.findall(REFERENCES.read_text("utf-8"))}


def test_every_work_cited_is_in_the_list_of_references() -> None:
    known = entries()
    assert len(known) > 10
    wrong = [f"{name}: {work}" for name, cited in cited_in().items() for work in cited - known]
    wrong += [
        f"{name}: {found}: write NAME (YEAR)" for name, s in own() for found in BARE.findall(s)
    ]
    assert sorted(wrong) == []


def test_every_entry_of_the_list_is_cited_somewhere() -> None:
    assert sorted(entries().difference(*cited_in().values())) == []


def test_code_that_names_an_equation_names_its_work() -> None:
    cited = cited_in()
    unclear = [
        name
        for name, text in texts()
        if name.endswith(".py") and EQUATION.search(text) and not cited.get(name)
    ]
    assert unclear == []


def test_every_page_of_mathematics_is_in_its_index_and_cites_code_that_is_there() -> None:
    index = (MATHEMATICS / "index.md").read_text("utf-8")
    found = sorted(MATHEMATICS.glob("*.md"))
    assert [p.name for p in found if p.name != "index.md" and f"({p.name})" not in index] == []
    wrong = [
        f"{page.name}: {path}"
        for page in found
        for path in re.findall(r"`((?:processing|daemon|tests)/[\w/.-]+)`", page.read_text("utf-8"))
        if not (ROOT / path).exists()
    ]
    assert wrong == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("## Free network: P/P, and `P/C`\n", {"free-network-pp-and-pc"}),
        ("```\n# no heading\n```\n# One\n", {"one"}),
        ("# A - b\n", set()),
        ("# Ä\n", set()),
    ],
)
def test_an_anchor_is_what_site_and_forge_agree_on(text: str, expected: set[str]) -> None:
    assert anchors(text) == expected


def test_a_reference_to_a_missing_section_is_found() -> None:
    assert problem_of(REFERENCES, "no-such-section") == "the page has no such section"
    assert problem_of(ROOT / "docs/no-such-page.md", "") == "there is no such file"
    assert problem_of(REFERENCES, "camera-models-and-adjustment") is None
    assert NOWHERE.search("Source: DESIGN 5.3") and NOWHERE.search("seeds/paper.txt, eq. 1")
    assert not NOWHERE.search("DESIGN_PHASE_PX = 1")
