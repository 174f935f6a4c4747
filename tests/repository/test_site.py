"""The documents' site: generated pages are complete, and it builds and opens without a network."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Final

import pytest

from docs._site import formulas, interfaces, tables
from docs._site.hook import on_page_markdown, with_links
from docs._site.pages import generated_pages
from tests.support.browser import Browser

ROOT: Final = Path(__file__).parents[2]
BUILD_TIMEOUT_S: Final = 600
FETCHED: Final = re.compile(r'<(?:script|link|img|iframe|source)\b[^>]*(?:src|href)="([^"]+)"')


def rows_of(page: str) -> set[str]:
    """What the first cells of the tables of a generated page name."""
    return set(re.findall(r"^\| `([^`]+)`", generated_pages()[page], re.MULTILINE))


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; links, anchors and docstrings that are wrong end the build."""
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("MkDocs is not installed here; `make docs` installs it")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [
            *(sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"),
            *("--site-dir", str(folder)),
        ],
        cwd=ROOT,
        env={"NO_MKDOCS_2_WARNING": "1", "PATH": "/usr/bin:/bin", "HOME": str(folder)},
        capture_output=True,
        text=True,
        timeout=BUILD_TIMEOUT_S,
        check=False,
    )
    assert (built.returncode, built.stdout + built.stderr) == (0, "")
    return folder


def test_every_command_and_option_is_on_a_page() -> None:
    from daemon.cli.command_table import TABLE

    pages = "".join(t for p, t in generated_pages().items() if p.startswith("reference/commands/"))
    assert [name for name in TABLE if f"\n## syntopic {name}\n" not in pages] == []
    assert "### syntopic calibrate lab\n" in pages
    assert "| `--exposures` | integer, at least 1 | `12` | Number of exposures. |" in pages


def test_every_key_of_the_configuration_is_on_its_page() -> None:
    from daemon.configuration.model import Configuration

    page = generated_pages()["reference/configuration.md"]
    for name, field in Configuration.model_fields.items():
        assert f"## `[{name}]`" in page or f"## `[[{name}]]`" in page, name
        inner = getattr(field.annotation, "model_fields", {})
        assert set(inner) <= rows_of("reference/configuration.md") | {"mavlink"}, name
    assert "| `port` | integer |  | `8470` | ≥ 0, ≤ 65535 |" in page
    assert "| `smear_px` | number | px | `0.5` | > 0, ≤ 10 |" in page


def test_every_key_of_the_configuration_has_a_meaning() -> None:
    from daemon.configuration.model import Configuration

    listed = list(tables.sections(Configuration.model_json_schema()))
    assert sum(len(rows) for _, _, rows in listed) > 70
    assert [(header, row[0]) for header, _, rows in listed for row in rows if not row[-1]] == []


def test_every_key_of_a_rig_file_has_a_meaning() -> None:
    from processing.rig.rig_file import RigFile

    listed = list(tables.sections(RigFile.model_json_schema()))
    assert sum(len(rows) for _, _, rows in listed) > 60
    assert [(header, row[0]) for header, _, rows in listed for row in rows if not row[-1]] == []


def test_every_key_of_a_rig_file_is_on_its_page() -> None:
    from processing.rig import Cone, Lens, Sensor, ThermalDrift, VirtualImage

    keys = rows_of("reference/rig-file.md")
    for part in (Cone, Lens, Sensor, ThermalDrift, VirtualImage):
        named = {field.name for field in fields(part)} - {"sensors", "lens", "drift"}
        assert named - keys - {"residual_grid"} == set(), part
    page = generated_pages()["reference/rig-file.md"]
    assert "| `pitch_um` | number | µm | required | ≥ 0.1, ≤ 1000 |" in page
    assert "## `[[cone.sensor]]`" in page


def test_every_flag_and_every_metric_is_on_its_page() -> None:
    from processing.quality.report import Flag

    assert rows_of("reference/flight/flags.md") == {flag.name for flag in Flag}
    source = (ROOT / "daemon/onboard/monitoring/metrics.py").read_text("utf-8")
    named = set(re.findall(r'"(syntopic_\w+)"', source)) - {"syntopic"}
    listed = {name.removesuffix("_total") for name in rows_of("reference/flight/metrics.md")}
    assert named - listed == set()


def test_every_route_is_on_its_page() -> None:
    page = generated_pages()["reference/flight/api.md"]
    paths = interfaces.openapi()["paths"]
    assert len(paths) > 10
    assert [path for path in paths if f" {path}\n" not in page] == []


def test_a_key_states_its_type_unit_and_limits() -> None:
    schema = {
        "properties": {
            "gain_max_db": {"type": "number", "minimum": 0, "maximum": 48, "default": 12.0},
            "mode": {"enum": ["a", "b"], "type": "string"},
            "inner": {"anyOf": [{"$ref": "#/$defs/Inner"}, {"type": "null"}]},
        },
        "required": ["mode"],
        "$defs": {"Inner": {"properties": {"p": {"type": "string", "format": "path"}}}},
    }
    (_, _, top), (name, _, inner) = tables.sections(schema)
    assert top[0] == ("`gain_max_db`", "number", "dB", "`12.0`", "≥ 0, ≤ 48", "")
    assert top[1] == ("`mode`", "choice", "", "required", "`a`, `b`", "")
    assert (name, inner[0][1]) == ("[inner]", "path")


def test_a_formula_becomes_mathml_and_an_unknown_command_ends_the_build() -> None:
    page = formulas.with_mathml(r'<p><span class="arithmatex">\(x^2\)</span></p>')
    assert page.startswith("<p><math") and "arithmatex" not in page
    with pytest.raises(ValueError, match="unknowncommand"):
        formulas.with_mathml(r'<span class="arithmatex">\(\unknowncommand x\)</span>')


def test_links_out_of_the_documents_lead_to_copies_or_become_paths() -> None:
    class File:
        src_uri = "explanation/pace.md"

    class Page:
        file = File()

    text = "[a](../../benchmarks/README.md) [b](../../Makefile) [c](time.md#one) `[d](x)`"
    written = on_page_markdown(text, Page())
    assert written == (
        "[a](../reference/results/benchmarks.md) b (`Makefile`) [c](time.md#one) `[d](x)`"
    )
    named = with_links("(docs/explanation/mathematics/time.md#clock-model)", "reference/a.md")
    assert named == "([time](../explanation/mathematics/time.md#clock-model))"


def test_no_page_fetches_anything_from_a_network(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 100
    fetched = {
        f"{page.relative_to(site)}: {place}"
        for page in pages
        for place in FETCHED.findall(page.read_text("utf-8"))
        if re.match(r"(?:[a-z]+:)?//", place)
    }
    assert fetched == set()


@pytest.mark.peer
def test_a_browser_searches_and_draws_formulas_without_a_network(
    site: Path, tmp_path: Path
) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.call("Emulation.setFocusEmulationEnabled", enabled=True)
        browser.open((site / "explanation/mathematics/coordinates.html").as_uri())
        browser.wait_for("document.readyState === 'complete'", 30)
        assert browser.evaluate("document.querySelectorAll('math').length") > 20
        assert browser.evaluate("document.querySelector('math').getBoundingClientRect().width") > 5
        browser.open((site / "index.html").as_uri() + "?q=boresight")
        browser.wait_for("document.querySelectorAll('.md-search-result__item').length > 0", 60)
        outside = [url for url in browser.requested if not url.startswith(("file:", "data:"))]
        assert [url for url in outside if not url.startswith("blob:")] == []
        assert browser.complaints == []
