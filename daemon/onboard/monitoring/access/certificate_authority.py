"""A local certificate authority and the server certificate that it signs, made with openssl(1).

The authority is for one machine: it may sign for names below .local, private addresses, and the
names it was made with (name constraints, RFC 5280, section 4.2.1.10), so that a tablet that trusts
it trusts it for nothing else.
"""

from __future__ import annotations

import hashlib
import re
import secrets
import shutil
import socket
import ssl
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from ipaddress import IPv4Network, IPv6Network, ip_address, ip_network
from pathlib import Path

from daemon.mission.store import durable
from daemon.onboard.monitoring.access.certificates import (
    TlsCertificateError,
    machine_names,
    server_context,
)
from drivers.base.extras import require

AUTHORITY_CERTIFICATE, AUTHORITY_KEY = "authority.pem", "authority.key"
SERVER_CERTIFICATE, SERVER_KEY = "server.pem", "server.key"
AUTHORITY_DAYS = 3650
SERVER_DAYS = 397
"""Above 825, tablets of Apple refuse a server certificate (support article 103769)."""
OPENSSL_TIMEOUT_S = 60.0
NAMES_MAX = 64
_AUTHORITY_NAME = "Syntopic"
_NAME = re.compile(r"(?=.{1,253}\Z)[a-z0-9]([a-z0-9\-]{0,62})(\.[a-z0-9]([a-z0-9\-]{0,62}))*")
_Network = IPv4Network | IPv6Network
_PRIVATE = (
    *("127.0.0.0/8", "10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16"),
    *("::1/128", "fc00::/7", "fe80::/10"),
)


@dataclass(frozen=True)
class IssuedCertificate:
    """The created files, the names in the certificate, and the SHA-256 of the authority."""

    certificate: Path
    key: Path
    authority: Path
    names: tuple[str, ...]
    fingerprint: str
    is_new_authority: bool


def issue_certificate(
    folder: Path,
    *,
    authority: Path | None = None,
    names: Sequence[str] = (),
    days: int = SERVER_DAYS,
) -> IssuedCertificate:
    """Create a server certificate, and its authority if there is none.

    Existing files are used again: the authority, and the server's key, so that a renewal replaces
    one file, at once.

    Args:
        folder: of the server's certificate and key.
        authority: of the authority's; `folder` if omitted.
        names: DNS names and IP addresses besides those of this machine.
        days: how long the server certificate is valid.

    Raises:
        TlsCertificateError: openssl is missing or refuses, a name is none, or files do not fit.
    """
    openssl = _Openssl()
    authority = authority or folder
    subject_names = _checked_names([*machine_names(), "localhost", *machine_addresses(), *names])
    for created in (folder, authority):
        durable.make_directories(created.absolute())
    certificate, key = folder / SERVER_CERTIFICATE, folder / SERVER_KEY
    signer, signer_key = authority / AUTHORITY_CERTIFICATE, authority / AUTHORITY_KEY
    _refuse_foreign(openssl, certificate, signer)
    is_new = not signer.exists()
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        if is_new:
            _create_key(openssl, signer_key, mode=0o600)
            durable.replace_file(signer, _authority(openssl, work, signer_key, subject_names))
        elif not signer_key.exists():
            raise TlsCertificateError(
                f"{signer_key} is missing, and nothing can be signed without it; name its folder "
                f"with --authority, or remove {signer} to make a new authority"
            )
        _create_key(openssl, key, mode=0o640)
        signed = work / "signed.pem"
        signed.write_bytes(_server(openssl, work, key, signer, signer_key, subject_names, days))
        try:
            openssl("verify", "-CAfile", signer, "-purpose", "sslserver", signed)
        except TlsCertificateError as error:
            raise TlsCertificateError(
                f"{signer} may not sign for all of {', '.join(subject_names)} ({error}); remove "
                f"{signer} to make a new authority, and install it on the tablets"
            ) from error
        server_context(signed, key)
        durable.replace_file(certificate, signed.read_bytes())
    return IssuedCertificate(
        certificate, key, signer, subject_names, fingerprint_of(signer), is_new
    )


def machine_addresses() -> tuple[str, ...]:
    """The addresses of this machine's interfaces, IPv4 first, without link-local ones."""
    require("watch")
    import ifaddr

    found = [
        ip_address(one.ip if isinstance(one.ip, str) else one.ip[0])
        for adapter in ifaddr.get_adapters()
        for one in adapter.ips
    ]
    usable = {one for one in found if not (one.version == 6 and one.is_link_local)}
    return tuple(str(one) for one in sorted(usable, key=lambda one: (one.version, int(one))))


def fingerprint_of(certificate: Path) -> str:
    """SHA-256 of a certificate, as tablets show it: pairs of hexadecimal digits.

    Raises:
        TlsCertificateError: the file is no certificate.
    """
    try:
        encoded = ssl.PEM_cert_to_DER_cert(certificate.read_text("ascii").strip())
    except (OSError, ValueError) as error:
        raise TlsCertificateError(f"{certificate} is no PEM certificate ({error})") from error
    return hashlib.sha256(encoded).digest().hex(":").upper()


class _Openssl:
    """The program; a call returns what it prints."""

    def __init__(self) -> None:
        found = shutil.which("openssl")
        if found is None:
            raise TlsCertificateError("openssl is not installed; run: sudo apt install openssl")
        self._program = found

    def __call__(self, *arguments: object) -> bytes:
        done = subprocess.run(
            [self._program, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=OPENSSL_TIMEOUT_S,
            check=False,
        )
        if done.returncode:
            lines = (done.stderr or done.stdout).decode("utf-8", "replace").strip().splitlines()
            reason = next((line for line in lines if "error" in line), "") or "".join(lines[-1:])
            raise TlsCertificateError(f"openssl {arguments[0]} refused: {reason}")
        return done.stdout


def _refuse_foreign(openssl: _Openssl, certificate: Path, signer: Path) -> None:
    """Refuse to replace a certificate of another authority, or a damaged one without ours."""
    if not certificate.exists():
        return
    try:
        issuer = openssl("x509", "-noout", "-issuer", "-nameopt", "multiline", "-in", certificate)
    except TlsCertificateError:
        if signer.exists():
            return
        issuer = b""
    if _AUTHORITY_NAME.encode() not in issuer:
        raise TlsCertificateError(
            f"{certificate} is signed by another authority, and is not replaced. Move it, or give "
            "another folder with --folder"
        )


def _create_key(openssl: _Openssl, path: Path, *, mode: int) -> None:
    """Create a key of the curve P-256 if there is none."""
    if not path.exists():
        created = openssl("genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256")
        durable.replace_file(path, created, mode=mode)


def _authority(openssl: _Openssl, work: Path, key: Path, names: Sequence[str]) -> bytes:
    host = re.sub(r"[^A-Za-z0-9.\-]", "-", socket.gethostname())[:40]
    permitted = [f"permitted;DNS.{i} = {name}" for i, name in enumerate([*_dns(names), "local"])]
    networks = [ip_network(text) for text in _PRIVATE]
    networks += [one for one in map(ip_network, _ip(names)) if not _is_within(one, networks)]
    permitted += [
        f"permitted;IP.{i} = {network.network_address.exploded}/{network.netmask.exploded}"
        for i, network in enumerate(networks)
    ]
    config = _config(
        work,
        "[subject]",
        f"CN = {_AUTHORITY_NAME} {host} {datetime.now(UTC):%Y-%m-%d}",
        "[extensions]",
        "basicConstraints = critical, CA:true, pathlen:0",
        "keyUsage = critical, keyCertSign, cRLSign",
        "subjectKeyIdentifier = hash",
        "nameConstraints = critical, @permitted",
        "[permitted]",
        *permitted,
    )
    return openssl(
        *("req", "-x509", "-new", "-sha256", "-key", key, "-config", config),
        *("-days", AUTHORITY_DAYS, "-set_serial", _serial(), "-extensions", "extensions"),
    )


def _server(
    openssl: _Openssl,
    work: Path,
    key: Path,
    signer: Path,
    signer_key: Path,
    names: Sequence[str],
    days: int,
) -> bytes:
    config = _config(
        work,
        "[subject]",
        f"CN = {names[0][:64]}",
        "[extensions]",
        "basicConstraints = critical, CA:false",
        "keyUsage = critical, digitalSignature",
        "extendedKeyUsage = serverAuth",
        "subjectKeyIdentifier = hash",
        "authorityKeyIdentifier = keyid",
        "subjectAltName = @names",
        "[names]",
        *(f"DNS.{i} = {name}" for i, name in enumerate(_dns(names))),
        *(f"IP.{i} = {name}" for i, name in enumerate(_ip(names))),
    )
    request = work / "request.pem"
    request.write_bytes(openssl("req", "-new", "-sha256", "-key", key, "-config", config))
    return openssl(
        *("x509", "-req", "-sha256", "-in", request, "-CA", signer, "-CAkey", signer_key),
        *("-days", days, "-set_serial", _serial()),
        *("-extfile", config, "-extensions", "extensions"),
    )


def _config(work: Path, *lines: str) -> Path:
    path = work / "openssl.cnf"
    head = ("[req]", "prompt = no", "distinguished_name = subject", "string_mask = utf8only")
    path.write_text("\n".join((*head, *lines, "")), "ascii")
    return path


def _checked_names(names: Sequence[str]) -> tuple[str, ...]:
    checked = []
    for name in names:
        try:
            checked.append(str(ip_address(name)))
        except ValueError:
            if not _NAME.fullmatch(name.lower()):
                raise TlsCertificateError(
                    f"{name!r} is neither a DNS name nor an IP address; give it with --name"
                ) from None
            checked.append(name.lower())
    different = tuple(dict.fromkeys(checked))
    if len(different) > NAMES_MAX:
        raise TlsCertificateError(f"{len(different)} names; a certificate has {NAMES_MAX} at most")
    return different


def _dns(names: Sequence[str]) -> list[str]:
    return [name for name in names if name not in _ip(names)]


def _ip(names: Sequence[str]) -> list[str]:
    return [name for name in names if ":" in name or re.fullmatch(r"[0-9.]+", name)]


def _is_within(one: _Network, others: Sequence[_Network]) -> bool:
    return any(one.network_address in other for other in others)


def _serial() -> str:
    """Positive, 159 random bits: within the 20 bytes that RFC 5280 allows."""
    return f"0x{secrets.randbits(159) | 1:x}"
