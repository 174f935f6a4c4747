"""The table of devices: every driver has its proofs, and the page is that of the code."""

from __future__ import annotations

from pathlib import Path

from drivers.base import registry
from drivers.base.device_support import (
    PAGES,
    SUPPORT,
    ProofKind,
    is_from_manual_only,
    markdown_table,
    proof_summary,
    support_of,
)

REFERENCE = Path(__file__).parents[2] / "docs/reference"


def test_every_driver_has_one_entry_with_proofs() -> None:
    entries = [(one.kind, one.driver) for one in SUPPORT]
    drivers = [(kind, name) for kind, names in registry.kinds().items() for name in names]
    assert sorted(entries) == sorted(drivers)
    assert all(one.proofs and one.devices for one in SUPPORT)


def test_the_page_holds_the_table_of_the_code() -> None:
    page = (REFERENCE / "devices.md").read_text(encoding="utf-8")
    assert markdown_table() in page, "python -m drivers.base.device_support prints the table"
    for one in SUPPORT:
        assert (REFERENCE / "drivers" / f"{PAGES.get(one.driver, one.driver)}.md").is_file()


def test_the_page_explains_every_kind_of_proof() -> None:
    page = (REFERENCE / "devices.md").read_text(encoding="utf-8")
    assert [
        kind.value for kind in ProofKind if f"| {kind.value} |" not in page.split("##")[0]
    ] == []


def test_what_is_read_by_the_manual_only_is_named() -> None:
    manual_only = [
        one.driver for one in SUPPORT if is_from_manual_only(one.kind, one.driver, "event marks")
    ]
    assert manual_only == ["sbg", "vectornav", "xsens", "applanix", "gsof"]
    assert not is_from_manual_only("navigator", "vectornav", "attitude")
    assert "the manual only (MT0101P)" in proof_summary("navigator", "xsens")
    assert support_of("navigator", "none") is None
    assert proof_summary("navigator", "none") == ""
    assert not is_from_manual_only("navigator", "none", "event marks")
