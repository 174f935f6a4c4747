"""Certificates that a client would refuse, or that are no secret, are found before the flight."""

from __future__ import annotations

import json
import os
import socket
import ssl
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.model import WatchSection
from daemon.onboard.monitoring.access import certificate_authority
from daemon.onboard.monitoring.access.certificate_authority import issue_certificate
from daemon.onboard.monitoring.access.certificates import (
    Certificate,
    CertificateFiles,
    TlsCertificateError,
    expiry_warning,
    machine_names,
    name_problem,
    read_certificate,
    server_context,
    validity_problem,
)
from daemon.onboard.monitoring.monitoring_prerequisites import check_monitoring
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult

pytestmark = pytest.mark.trust
DAY_S = 86_400.0


@pytest.fixture(scope="module")
def issued(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tls")
    issue_certificate(folder, names=["camera1.example.org"])
    return folder


@pytest.fixture
def tls(issued: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    for path in issued.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
        (tmp_path / path.name).chmod(path.stat().st_mode & 0o777)
    return tmp_path


def openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True, timeout=60)


def greet(server: ssl.SSLContext, client: ssl.SSLContext, name: str) -> None:
    """A handshake in memory. Raises ssl.SSLError where the client does not trust the server."""
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    client_side = client.wrap_bio(to_client, to_server, server_hostname=name)
    answering = server.wrap_bio(to_server, to_client, server_side=True)
    for end in (client_side, answering, client_side, answering):
        try:
            end.do_handshake()
        except ssl.SSLWantReadError:
            continue
    assert client_side.getpeercert()


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion")
def test_a_client_that_trusts_the_authority_accepts_the_machine_by_its_names(issued: Path) -> None:
    server = server_context(issued / "server.pem", issued / "server.key")
    client = ssl.create_default_context(cafile=str(issued / "authority.pem"))
    host = socket.gethostname().lower().partition(".")[0]
    for name in (f"{host}.local", "127.0.0.1", "::1", "localhost", "camera1.example.org"):
        greet(server, client, name)
    with pytest.raises(ssl.SSLCertVerificationError, match="Hostname mismatch"):
        greet(server, client, "other.local")
    with pytest.raises(ssl.SSLCertVerificationError, match="unable to get local issuer"):
        greet(server, ssl.create_default_context(), "localhost")
    old = ssl.create_default_context(cafile=str(issued / "authority.pem"))
    old.set_ciphers("DEFAULT:@SECLEVEL=0")
    old.minimum_version = ssl.TLSVersion.TLSv1
    old.maximum_version = ssl.TLSVersion.TLSv1_1
    with pytest.raises(ssl.SSLError, match=r"UNSUPPORTED_PROTOCOL|PROTOCOL_VERSION"):
        greet(server, old, "localhost")


def test_keys_are_private_and_the_authority_signs_for_nothing_else(tls: Path) -> None:
    modes = {path.name: path.stat().st_mode & 0o777 for path in tls.iterdir()}
    assert modes["authority.key"] == 0o600 and modes["server.key"] == 0o640
    before = (tls / "server.pem").read_bytes()
    with pytest.raises(TlsCertificateError, match=r"may not sign for all of .*bank\.example"):
        issue_certificate(tls, names=["bank.example"])
    assert (tls / "server.pem").read_bytes() == before
    (tls / "authority.pem").unlink()
    again = issue_certificate(tls, names=["bank.example"])
    assert again.is_new_authority and "bank.example" in again.names


def test_a_renewal_keeps_authority_and_key_and_replaces_one_file(tls: Path) -> None:
    before = {path.name: path.read_bytes() for path in tls.iterdir()}
    again = issue_certificate(tls, names=["camera1.example.org"])
    after = {path.name: path.read_bytes() for path in tls.iterdir()}
    assert not again.is_new_authority
    assert [name for name in before if before[name] != after[name]] == ["server.pem"]
    (tls / "authority.key").rename(tls.parent / "away.key")
    with pytest.raises(TlsCertificateError, match=r"authority\.key is missing.*--authority"):
        issue_certificate(tls)


@pytest.mark.parametrize("name", ["a b", "x\nDNS.9 = evil", "-x.local", "..", "x" * 254, "*"])
def test_a_name_that_is_none_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(TlsCertificateError, match="neither a DNS name nor an IP address"):
        issue_certificate(tmp_path, names=[name])
    assert not list(tmp_path.iterdir())


def _missing(tls: Path) -> None:
    (tls / "server.key").unlink()


def _damaged(tls: Path) -> None:
    (tls / "server.pem").write_text("-----BEGIN CERTIFICATE-----\nAAAA\n")


def _other_key(tls: Path) -> None:
    openssl("genpkey", "-algorithm", "ED25519", "-out", tls / "other.key")
    (tls / "server.key").write_bytes((tls / "other.key").read_bytes())


def _other_key_of_the_same_kind(tls: Path) -> None:
    (tls / "server.key").write_bytes((tls / "authority.key").read_bytes())


def _encrypted(tls: Path) -> None:
    plain, key = tls / "authority.key", tls / "server.key"
    openssl("pkey", "-in", plain, "-aes256", "-passout", "pass:x", "-out", tls / "encrypted.key")
    key.write_bytes((tls / "encrypted.key").read_bytes())


def _readable_by_all(tls: Path) -> None:
    (tls / "server.key").chmod(0o644)


def _a_pipe(tls: Path) -> None:
    (tls / "server.pem").unlink()
    os.mkfifo(tls / "server.pem")


def _a_folder(tls: Path) -> None:
    (tls / "server.key").unlink()
    (tls / "server.key").mkdir(mode=0o750)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_missing, "server.key cannot be read"),
        (_damaged, "cannot be loaded"),
        (_other_key, "is not the key of|cannot be loaded"),
        (_other_key_of_the_same_kind, "is not the key of"),
        (_encrypted, "is encrypted.*openssl pkey"),
        (_readable_by_all, "all users.*chmod 640"),
        (_a_pipe, "not a regular file"),
        (_a_folder, "not a regular file"),
    ],
)
@pytest.mark.timeout(20)
def test_what_cannot_be_used_is_refused_with_its_cure(
    damage: Callable[[Path], None], sentence: str, tls: Path
) -> None:
    damage(tls)
    with pytest.raises(TlsCertificateError, match=sentence):
        server_context(tls / "server.pem", tls / "server.key")
    (result,) = results(tls)
    assert result.outcome is CheckOutcome.FAIL and "Monitoring is not possible" in result.sentence


def results(tls: Path, host: str = "127.0.0.1") -> list[CheckResult]:
    settings = WatchSection(
        host=host, tls_certificate=tls / "server.pem", tls_key=tls / "server.key"
    )
    return list(check_monitoring(settings, port=False))


def self_signed(tls: Path, *extensions: str, days: int = 365) -> None:
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-subj", "/CN=x", "-days", days),
        *("-keyout", tls / "server.key", "-out", tls / "server.pem"),
        *(part for extension in extensions for part in ("-addext", extension)),
    )
    (tls / "server.key").chmod(0o600)


def expire(tls: Path) -> None:
    """Put a certificate there that the authority signed and that has expired."""
    openssl("req", "-new", "-key", tls / "server.key", "-subj", "/CN=x", "-out", tls / "asked.pem")
    (tls / "names.cnf").write_text(f"subjectAltName=DNS:{machine_names()[0]},IP:127.0.0.1\n")
    openssl(
        *("x509", "-req", "-in", tls / "asked.pem", "-days", 0, "-extfile", tls / "names.cnf"),
        *("-CA", tls / "authority.pem", "-CAkey", tls / "authority.key", "-set_serial", 1),
        *("-out", tls / "server.pem"),
    )
    time.sleep(1.1)  # its last second is this one


def test_a_good_certificate_passes(tls: Path) -> None:
    assert [result.outcome for result in results(tls)] == [CheckOutcome.PASS, CheckOutcome.PASS]
    assert [result.outcome for result in results(tls, "0.0.0.0")][1] is CheckOutcome.PASS
    incomplete = results(tls, "192.0.2.99")[1]
    assert (
        incomplete.outcome is CheckOutcome.FAIL
        and "does not contain 192.0.2.99" in incomplete.sentence
    )


def test_a_certificate_for_another_machine_or_another_purpose_is_found(tls: Path) -> None:
    self_signed(tls, "subjectAltName=DNS:other.local,IP:127.0.0.1")
    assert "none of this machine's names" in results(tls)[1].sentence
    self_signed(tls, f"subjectAltName=DNS:{machine_names()[0]},IP:127.0.0.1")
    assert [result.outcome for result in results(tls)] == [CheckOutcome.PASS, CheckOutcome.PASS]
    self_signed(tls, "extendedKeyUsage=clientAuth")
    (result,) = results(tls)
    assert result.outcome is CheckOutcome.FAIL and "is not a server certificate" in result.sentence


def test_expired_and_soon_expiring_certificates_are_found(tls: Path) -> None:
    issue_certificate(tls, names=["camera1.example.org"], days=20)
    late = results(tls)[1]
    assert late.outcome is CheckOutcome.WAITING and "expires in 20 days" in late.sentence
    expire(tls)
    expired = results(tls)
    assert [result.outcome for result in expired] == [CheckOutcome.PASS, CheckOutcome.FAIL]
    assert "expired on" in expired[1].sentence, "it is served, and clients refuse it"


def test_dates_and_names_are_compared_as_clients_do() -> None:
    available = Certificate(
        frozenset({"a.local", "*.example.org"}), frozenset({"10.0.0.5"}), 0.0, DAY_S
    )
    assert "set the clock" in (validity_problem(available, -1.0) or "")
    assert validity_problem(available, 0.0) is None and validity_problem(available, DAY_S) is None
    assert "expired" in (validity_problem(available, DAY_S + 1) or "")
    assert expiry_warning(available, DAY_S - 30 * DAY_S) is None
    assert expiry_warning(available, DAY_S - 30 * DAY_S + 1) is not None
    assert expiry_warning(available, DAY_S + 1) is None
    assert name_problem(available, "0.0.0.0", ["b.local", "a.local"]) is None
    assert name_problem(available, "10.0.0.5", ["c1.example.org"]) is None
    assert name_problem(available, "10.0.0.6", ["a.local"]) is not None
    assert name_problem(available, "0.0.0.0", ["c.d.example.org"]) is not None


def test_a_renewed_certificate_is_used_and_a_damaged_one_reported_once(tls: Path) -> None:
    pem, key = tls / "server.pem", tls / "server.key"
    files = CertificateFiles(pem, key, server_context(pem, key))
    first = files.context
    assert not files.renewed()
    issue_certificate(tls, names=["camera1.example.org"])
    assert files.renewed() and files.context is not first
    second, good = files.context, pem.read_bytes()
    pem.write_text("no certificate")
    with pytest.raises(TlsCertificateError):
        files.renewed()
    assert not files.renewed() and files.context is second
    pem.write_bytes(good)
    assert files.renewed()
    assert read_certificate(pem, files.context).names >= {"camera1.example.org"}


def test_a_fingerprint_is_printed_digit_by_digit(tmp_path: Path, monkeypatch) -> None:
    """`:CD:` and `:AB:` are names of pictures in a terminal library."""
    digits = "4E:CD:97:AB:12"
    monkeypatch.setattr(certificate_authority, "fingerprint_of", lambda _path: digits)
    printed = CliRunner().invoke(app, ["certificate", "--folder", str(tmp_path / "tls")])
    assert digits in printed.output


def test_the_command_makes_what_the_configuration_names(tmp_path: Path) -> None:
    made = CliRunner().invoke(app, ["certificate", "--folder", str(tmp_path / "tls"), "--json"])
    assert made.exit_code == 0, made.output
    reported = json.loads(made.stdout)
    assert machine_names()[0] in reported["names"] and "127.0.0.1" in reported["names"]
    assert [one.outcome for one in results(tmp_path / "tls")] == [
        CheckOutcome.PASS,
        CheckOutcome.PASS,
    ]
    printed = CliRunner().invoke(app, ["certificate", "--folder", str(tmp_path / "tls")])
    assert reported["authority_sha256"] in printed.output and 'tls_key = "' in printed.output
