"""Every quirk in drivers names the issue, the clause or the search that it comes from."""

from __future__ import annotations

import pytest

from tests.drivers.quirks import PAGE, modules, page, quirks_of, unmarked


def test_every_quirk_has_a_reference() -> None:
    found = [quirk for path, source in modules() for quirk in quirks_of(source, path)]
    assert len(found) > 40
    missing = [
        f"{quirk.path}:{quirk.line} {quirk.text}" for quirk in found if not quirk.has_reference
    ]
    assert not missing, "\n".join(missing)


def test_comments_on_quirks_are_marked() -> None:
    found = [
        f"{path}:{line} {text}" for path, source in modules() for line, text in unmarked(source)
    ]
    assert not found, "\n".join(found)


def test_the_page_lists_all_quirks() -> None:
    assert PAGE.read_text("utf-8") == page(), "run: python -m tests.drivers.quirks"


@pytest.mark.parametrize(
    ("comment", "has_reference"),
    [
        ("# Quirk: it fails. Upstream: owner/name#12.", True),
        ("# Quirk: it\n# fails. Upstream: no report known\n# (2026-11-23).", True),
        ("# Quirk: it fails. Upstream: manual: Linux, udp.c, __udp4_lib_err.", True),
        ("# Quirk: it fails.", False),
        ("# Quirk: it fails. Upstream: see the tracker.", False),
        ("# Quirk: it fails. Upstream: no report known.", False),
        ("# Quirk: it fails. Upstream: owner/name.", False),
        ("# Quirk: it fails.\n\n# Upstream: owner/name#12.", False),
    ],
)
def test_a_reference_is_recognized(comment: str, has_reference: bool) -> None:
    (quirk,) = quirks_of(f"{comment}\nX = 1\n", "x.py")
    assert quirk.text == "it fails."
    assert quirk.has_reference == has_reference


def test_a_reference_ends_its_quirk() -> None:
    source = "# Quirk: a. Upstream: o/n#1.\n# Quirk: b.\n# Upstream: o/n#2.\n# Another comment.\n"
    found = [(quirk.line, quirk.text, quirk.upstream) for quirk in quirks_of(source, "x.py")]
    assert found == [(1, "a.", "o/n#1"), (2, "b.", "o/n#2")]


@pytest.mark.parametrize(
    "comment",
    [
        "# Some heads send nothing.",
        "# Aravis drops it.",
        "# A workaround.",
        "# pyserial raises more.",
    ],
)
def test_an_unmarked_comment_is_found(comment: str) -> None:
    assert unmarked(f"{comment}\n") == [(1, comment.removeprefix("# "))]
    assert not unmarked(f"# Quirk: {comment[2:]} Upstream: owner/name#1.\n")
