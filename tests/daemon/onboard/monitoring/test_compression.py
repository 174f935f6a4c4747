"""The page and the state travel compressed; pictures and small answers do not."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from daemon.onboard.monitoring.access.command_gateway import CommandGateway
from daemon.onboard.monitoring.access.tokens import Tokens
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.web.api import AccessSettings, create_app
from daemon.onboard.monitoring.web.page_files import PAGE, accepts_gzip
from tests.daemon.onboard.monitoring import flight_events

GZIP = {"Accept-Encoding": "gzip"}
PLAIN = {"Accept-Encoding": "identity"}
FIRST_LOAD_MAX_BYTES = 190_000
IMPORT = re.compile(r'^import (?:[^;]*? from )?"\./([\w/]+\.js)";', re.MULTILINE)


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    state = FlightState("syntopic test", lambda _: [[47.0, 15.0]] * 4)
    state.apply(flight_events.mission(str(tmp_path)))
    for number in range(1, 60):
        for event in flight_events.exposure(number):
            state.apply(event)
    product = tmp_path / "L2/000001"
    product.mkdir(parents=True)
    (product / "quicklook.jpg").write_bytes(b"\xff\xd8" + bytes(5000))
    gateway = CommandGateway(lambda _: None)
    app = create_app(state, gateway, AccessSettings(Tokens(tmp_path / "none.toml")))
    with TestClient(app) as client:
        yield client


@pytest.mark.parametrize("name", ["", "vendor/leaflet.js", "page.css", "messages/de/server.json"])
def test_a_file_of_the_page_is_the_same_compressed(client: TestClient, name: str) -> None:
    packed, plain = (client.get(f"/{name}", headers=one) for one in (GZIP, PLAIN))
    assert packed.headers["Content-Encoding"] == "gzip"
    assert "Content-Encoding" not in plain.headers
    assert packed.content == plain.content == (PAGE / (name or "index.html")).read_bytes()
    assert int(packed.headers["Content-Length"]) < 0.5 * int(plain.headers["Content-Length"])
    assert all("Accept-Encoding" in one.headers["Vary"] for one in (packed, plain))
    assert packed.headers["Content-Type"] == plain.headers["Content-Type"]
    assert packed.headers["ETag"] != plain.headers["ETag"]
    assert "Content-Security-Policy" in packed.headers


@pytest.mark.parametrize("accepted", [GZIP, PLAIN])
def test_an_unchanged_file_is_not_sent_again(client: TestClient, accepted: dict[str, str]) -> None:
    first = client.get("/page.js", headers=accepted)
    again = client.get("/page.js", headers={**accepted, "If-None-Match": first.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["ETag"] == first.headers["ETag"]
    other = GZIP if accepted is PLAIN else PLAIN
    changed = client.get("/page.js", headers={**other, "If-None-Match": first.headers["ETag"]})
    assert changed.status_code == 200, "the tag of one form does not stand for the other"


def test_a_part_of_a_file_and_its_head_are_of_the_plain_and_the_packed_file(
    client: TestClient,
) -> None:
    part = client.get("/page.js", headers={**GZIP, "Range": "bytes=0-9"})
    assert (part.status_code, part.content) == (206, (PAGE / "page.js").read_bytes()[:10])
    head = client.head("/page.js", headers=GZIP)
    assert (head.headers["Content-Encoding"], head.status_code) == ("gzip", 200)


def test_all_files_of_the_first_load_are_small(client: TestClient) -> None:
    names = [one.name for one in PAGE.glob("*.js") if one.name not in ("worker.js", "api.js")]
    names += ["", "page.css", "panels.css", "map.css", "vendor/leaflet.js", "vendor/leaflet.css"]
    names += ["vendor/uplot.js", "vendor/uplot.css"]
    names += [f"messages/en/{one}.json" for one in ("page", "map", "alarm", "landing")]
    sizes = [int(client.get(f"/{one}", headers=GZIP).headers["Content-Length"]) for one in names]
    assert sum(sizes) < FIRST_LOAD_MAX_BYTES


def test_the_page_names_every_module_that_it_imports(client: TestClient) -> None:
    """Each level of imports that the browser has to find by itself costs a round trip."""
    found, frontier = set[str](), ["page.js"]
    while frontier:
        text = client.get(f"/{frontier.pop()}").text
        imported = set(
            re.findall(r'^import (?:[^;]*? from )?"\./([\w/]+\.js)";', text, re.MULTILINE)
        )
        frontier += imported - found
        found |= imported
    page = client.get("/").text
    assert sorted(re.findall(r'rel="modulepreload" href="([^"]+)"', page)) == sorted(found)
    assert len(found) > 40


def test_state_is_compressed_and_pictures_are_not(client: TestClient) -> None:
    packed, plain = (client.get("/api/v1/exposures", headers=one) for one in (GZIP, PLAIN))
    assert packed.headers["Content-Encoding"] == "gzip"
    assert packed.json() == plain.json() and len(packed.json()) == 59
    assert int(packed.headers["Content-Length"]) < 0.1 * int(plain.headers["Content-Length"])
    for address in ("/api/v1/exposures/1/quicklook.jpg", "/api/v1/devices"):
        assert "Content-Encoding" not in client.get(address, headers=GZIP).headers, address


@pytest.mark.parametrize(
    ("accepted", "is_accepted"),
    [
        ("gzip", True),
        ("GZIP;q=1.0", True),
        ("br, gzip;q=0.001", True),
        ("gzip;q=0", False),
        ("gzip; q=0.000", False),
        ("x-gzipped, br", False),
        ("", False),
    ],
)
def test_a_client_without_gzip_is_sent_none(accepted: str, is_accepted: bool) -> None:
    assert accepts_gzip(accepted) == is_accepted
