"""A known vulnerability fails the check; an unreachable database is reported, not passed over."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from tests.repository.audit import AuditError, Package, advisories, main, packages, problems


class Database:
    """An advisory database of our own: `known` is its content, `body` a reply in place of it."""

    def __init__(self) -> None:
        self.known: dict[tuple[str, str, str], list[str]] = {}
        self.body: bytes | None = None
        database = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                length = int(self.headers["Content-Length"])
                body = database.answer(json.loads(self.rfile.read(length)))
                self.send_response(200)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_port}/v1/querybatch"

    def answer(self, queried: dict[str, Any]) -> bytes:
        if self.body is not None:
            return self.body
        results = []
        for query in queried["queries"]:
            package = query["package"]
            key = (package["ecosystem"], package["name"], query["version"])
            names = [{"id": name, "modified": "2026-01-01"} for name in self.known.get(key, [])]
            results.append({"vulns": names} if names else {})
        return json.dumps({"results": results}).encode()


@pytest.fixture
def database() -> Iterator[Database]:
    fake = Database()
    thread = threading.Thread(target=fake.server.serve_forever, daemon=True)
    thread.start()
    yield fake
    fake.server.shutdown()
    fake.server.server_close()
    thread.join(5)


def test_everything_pinned_and_vendored_is_asked_for_in_its_version() -> None:
    listed = packages()
    assert len({package.name for package in listed}) > 80
    assert {p.ecosystem for p in listed} == {"PyPI", "npm"}
    assert all(p.version[0].isdigit() for p in listed)


def test_no_advisory_is_no_problem(database: Database, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([], database.address) == 0
    assert "0 advisories match" in capsys.readouterr().out


def test_an_advisory_of_a_pinned_version_fails_the_check(
    database: Database, capsys: pytest.CaptureFixture[str]
) -> None:
    pinned = next(p for p in packages() if p.name == "jinja2")
    database.known["PyPI", "jinja2", pinned.version] = ["PYSEC-2099-1"]
    database.known["PyPI", "jinja2", "0.1"] = ["PYSEC-2000-9"]
    assert main([], database.address) == 1
    stderr = capsys.readouterr().err
    assert f"jinja2 {pinned.version}" in stderr and "PYSEC-2099-1" in stderr
    assert "PYSEC-2000-9" not in stderr


def test_an_advisory_that_a_person_has_looked_at_is_let_pass_as_long_as_it_matches() -> None:
    found = {Package("PyPI", "jinja2", "3.0"): ["PYSEC-2099-1"]}
    assert problems(found, {"PYSEC-2099-1": "templates are ours"}) == []
    assert "matches nothing" in problems({}, {"PYSEC-2099-1": "templates are ours"})[0]


def test_an_unreachable_database_is_reported_and_fails_only_where_it_is_required(
    database: Database, capsys: pytest.CaptureFixture[str]
) -> None:
    closed = "http://127.0.0.1:1/v1/querybatch"
    assert main([], closed) == 0
    assert "NOT AUDITED" in capsys.readouterr().err
    assert main(["--required"], closed) == 2


@pytest.mark.parametrize(
    "body",
    [
        b'{"results": []}',
        b"",
        b"<html>sign in</html>",
        b"[]",
        b'{"results": [{}]}',
        b'{"results": [7]}',
    ],
)
def test_an_answer_that_is_none_is_not_taken_for_a_clean_one(
    database: Database, body: bytes
) -> None:
    database.body = body
    with pytest.raises(AuditError):
        advisories(packages(), database.address)


def test_a_page_without_names_that_goes_on_is_not_taken_for_a_clean_one(
    database: Database,
) -> None:
    queried = packages()
    database.body = json.dumps({"results": [{"next_page_token": "2"}] * len(queried)}).encode()
    with pytest.raises(AuditError, match="pages"):
        advisories(queried, database.address)
