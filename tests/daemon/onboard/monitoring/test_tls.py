"""Page, API, telemetry and `monitor` over TLS, by the real watch process."""

from __future__ import annotations

import json
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from daemon.cli import app
from daemon.configuration.model import WatchSection
from daemon.onboard.monitoring.access.certificate_authority import issue_certificate
from daemon.onboard.service.messages import Stop
from daemon.onboard.service.processes import ChildProcess
from tests.daemon.onboard.monitoring import flight_events
from tests.daemon.onboard.monitoring.page_service import Service
from tests.daemon.onboard.monitoring.test_certificates import expire, self_signed

pytestmark = pytest.mark.trust
RENEWED_WITHIN_S = 30.0


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    issue_certificate(tmp_path / "tls")
    service = serving(tmp_path)
    yield service
    service.end()


def serving(folder: Path, **further: Any) -> Service:
    files = {"tls_certificate": folder / "tls/server.pem", "tls_key": folder / "tls/server.key"}
    service = Service(folder, **files, **further)
    service.emit(flight_events.mission())
    service.emit(flight_events.status(triggers=3))
    return service


def watched(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["monitor", *arguments, "--json"])


def test_page_api_telemetry_and_commands_are_served_over_tls(
    service: Service, tmp_path: Path
) -> None:
    assert service.address.startswith("https://")
    trusting = ssl.create_default_context(cafile=str(tmp_path / "tls/authority.pem"))

    def get(path: str, **how: Any) -> bytes:
        urls = urllib.request.Request(service.address + path, **how)
        with urllib.request.urlopen(urls, timeout=30, context=trusting) as answer:
            return bytes(answer.read())

    assert b"<html" in get("")
    assert json.loads(get("api/v1/brief"))["version"] == 1
    with pytest.raises(urllib.error.URLError, match="CERTIFICATE_VERIFY_FAILED"):
        urllib.request.urlopen(service.address, timeout=30)
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(service.address.replace("https", "http"), timeout=30)
    assert b"This port requires TLS: use https://127.0.0.1:" in refused.value.read()
    seen = watched(service.address, "--authority", str(tmp_path / "tls/authority.pem"))
    assert seen.exit_code == 0, seen.output
    assert json.loads(seen.stdout)["status"]["ledger"]["triggers"]["triggers"] == 3


def test_a_token_reaches_a_closed_service_over_tls_only(tmp_path: Path) -> None:
    issue_certificate(tmp_path / "tls")
    service = serving(tmp_path, anonymous_read=False)
    try:
        authority = ("--authority", str(tmp_path / "tls/authority.pem"))
        nobody = watched(service.address, *authority)
        assert "reading may need a token" in str(nobody.exception)
        seen = watched(service.address, *authority, "--token", service.token)
        assert seen.exit_code == 0, seen.output
        foreign = watched(service.address, "--token", service.token)
        assert "its certificate is not accepted" in str(foreign.exception)
        plain = watched(service.address.replace("https", "http"))
        assert "This port requires TLS" in str(plain.exception)
    finally:
        service.end()


def test_a_certificate_that_expired_or_is_for_another_machine_is_not_accepted(
    tmp_path: Path,
) -> None:
    issue_certificate(tmp_path / "tls")
    authority = ("--authority", str(tmp_path / "tls/authority.pem"))
    expire(tmp_path / "tls")
    service = serving(tmp_path)
    try:
        reported = [one for one in service.events if one.get("device") == "certificate for clients"]
        assert "expired on" in reported[0]["sentence"], "and it is served all the same"
        assert "certificate has expired" in str(watched(service.address, *authority).exception)
    finally:
        service.end()
        (tmp_path / "tokens.toml").unlink()
    self_signed(tmp_path / "tls", "subjectAltName=DNS:other.local")
    service = serving(tmp_path)
    try:
        unknown = watched(service.address, *authority)
        assert "self-signed certificate" in str(unknown.exception)
        pinned = watched(service.address, "--authority", str(tmp_path / "tls/server.pem"))
        assert "IP address mismatch" in str(pinned.exception)
    finally:
        service.end()


def test_a_renewed_certificate_is_served_without_a_restart(
    service: Service, tmp_path: Path
) -> None:
    address = ("127.0.0.1", int(service.address.rstrip("/").rpartition(":")[2]))
    authority = str(tmp_path / "tls/authority.pem")
    before = ssl.get_server_certificate(address, ca_certs=authority, timeout=30)
    (tmp_path / "tls/server.pem").write_text("half a certif")
    service.until(lambda: certificate_events(service), RENEWED_WITHIN_S)
    assert "The previous certificate is still used" in certificate_events(service)[0]["sentence"]
    assert ssl.get_server_certificate(address, ca_certs=authority, timeout=30) == before
    issue_certificate(tmp_path / "tls")
    service.until(lambda: len(certificate_events(service)) == 2, RENEWED_WITHIN_S)
    assert certificate_events(service)[1]["fault"] is False
    after = ssl.get_server_certificate(address, ca_certs=authority, timeout=30)
    assert after.strip() == (tmp_path / "tls/server.pem").read_text().strip() != before.strip()


def certificate_events(service: Service) -> list[Any]:
    return [one for one in service.events if one.get("event") == "tls-certificate"]


def test_a_key_readable_by_all_users_is_not_served(tmp_path: Path) -> None:
    issue_certificate(tmp_path / "tls")
    (tmp_path / "tls/server.key").chmod(0o644)
    settings = WatchSection(
        port=0,
        announce=False,
        tls_certificate=tmp_path / "tls/server.pem",
        tls_key=tmp_path / "tls/server.key",
    )
    child = ChildProcess(
        "watch", "daemon.onboard.monitoring.monitoring_process:main", (settings,), {}
    )
    try:
        assert child.connection.poll(60)
        event = child.connection.recv().event
        assert (event["device"], event["fault"]) == ("certificate", True)
        assert "chmod 640" in event["sentence"]
    finally:
        child.send(Stop())
        child.end(10.0)
