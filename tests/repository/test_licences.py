"""Nothing gets into the product whose licence nobody has looked at."""

from __future__ import annotations

import sys

import pytest

from tests.repository.licences import EXCEPTIONS, PAGE, Package, packages, page, stated


def test_every_licence_is_on_a_list() -> None:
    found, _ = packages()
    assert len(found) > 60
    assert [problem for package in found if (problem := package.problem)] == []


def test_every_licence_of_what_builds_the_site_is_on_a_list() -> None:
    found, absent = packages("requirements-docs.lock")
    if "mkdocs" in absent:
        pytest.skip("MkDocs is not installed here; `make docs` installs it")
    assert [problem for package in found if (problem := package.problem)] == []


def test_no_exception_is_left_of_a_package_that_is_gone() -> None:
    found, _ = packages()
    assert set(EXCEPTIONS) <= {package.name for package in found if not package.is_tool}


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="the page is made on Python 3.11")
def test_the_page_of_licences_is_current() -> None:
    found, _ = packages()
    assert PAGE.read_text("utf-8") == page(found), (
        "run: python -m tests.repository.licences --write"
    )


@pytest.mark.parametrize(
    ("licence", "is_tool", "may"),
    [
        ("MIT", False, True),
        ("BSD-3-Clause AND 0BSD AND Zlib", False, True),
        ("GPL-2.0-only OR MIT", False, True),
        ("MIT AND GPL-3.0-only", False, False),
        ("GPL-3.0-or-later", True, False),
        ("MPL-2.0", True, True),
        ("MPL-2.0", False, False),
        ("", False, False),
        ("Proprietary", False, False),
    ],
)
def test_a_licence_is_judged_by_all_its_parts(licence: str, is_tool: bool, may: bool) -> None:
    assert (Package("something", licence, is_tool).problem is None) is may


def test_a_package_with_two_statements_must_satisfy_both() -> None:
    classifiers = [
        "License :: OSI Approved :: MIT License",
        "License :: OSI Approved :: GNU General Public License v3 (GPLv3)",
    ]
    assert Package("x", stated("", "", classifiers), is_tool=False).problem is not None
    assert Package("x", stated("", "", classifiers[:1]), is_tool=False).problem is None
