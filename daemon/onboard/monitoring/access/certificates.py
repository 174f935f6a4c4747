"""The service's TLS certificate: read, checked, and used by a server context.

Making certificates is in `daemon.onboard.monitoring.access.certificate_authority`.
"""

from __future__ import annotations

import socket
import ssl
import stat
import time
from collections.abc import Collection
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Final

from daemon import DaemonError

EXPIRES_SOON_S: Final = 30 * 86_400
NO_CHECK_TIME: Final = ssl.VerifyFlags(0x200000)
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL's <openssl/x509_vfy.h>; Python has no name for it."""
MISSING_FILE_STAMP: Final = (0, 0, 0)


class TlsCertificateError(DaemonError):
    """An unusable certificate or key; the message contains the reason and the corrective action."""


@dataclass(frozen=True)
class Certificate:
    """What a certificate states.

    `names` are DNS names in lower case, `addresses` IP addresses in their shortest form; both end
    of validity are in seconds of Unix time.
    """

    names: frozenset[str]
    addresses: frozenset[str]
    begins_s: float
    ends_s: float


def server_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """A context for TLS 1.2 and newer with this certificate.

    Raises:
        TlsCertificateError: a file is missing or damaged, the key belongs to another certificate,
        is
            encrypted, or readable by all users.
    """
    for path, setting in ((certificate, "tls_certificate"), (key, "tls_key")):
        mode = _mode_of_file(path, setting)
    if mode & 0o007:
        raise TlsCertificateError(
            f"{key} can be read or changed by all users of this machine and is not secret; make "
            f"a new one, or if it was not read: chmod 640 {key}"
        )

    def refuse_to_decrypt() -> str:
        raise TlsCertificateError(
            f"{key} is encrypted, and the service has no passphrase; store it "
            f"without one: openssl pkey -in {key} -out PLAIN"
        )

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION
    try:
        context.load_cert_chain(certificate, key, refuse_to_decrypt)
    except (OSError, ValueError) as error:
        if isinstance(error, ssl.SSLError) and error.reason == "KEY_VALUES_MISMATCH":
            raise TlsCertificateError(
                f"{key} is not the key of {certificate}; give the two that belong together"
            ) from error
        raise TlsCertificateError(
            f"{certificate} and {key} cannot be loaded ({error}); give a PEM certificate and its "
            "key (syntopic certificate makes both)"
        ) from error
    return context


def read_certificate(path: Path, context: ssl.SSLContext) -> Certificate:
    """What the certificate of a server context states.

    The certificate is read as a client sees it: from a handshake in memory, where it is itself what
    the client trusts.

    Args:
        path: the PEM file the context was made with.
        context: of `server_context`.

    Raises:
        TlsCertificateError: a client would not accept it for a server, whomever it trusts.
    """
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    client.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN | NO_CHECK_TIME
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        client.load_verify_locations(path)
        client_side = client.wrap_bio(to_client, to_server)
        server_side = context.wrap_bio(to_server, to_client, server_side=True)
        for end in (client_side, server_side, client_side, server_side):
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
        stated: dict[str, Any] = client_side.getpeercert() or {}
    except (OSError, ValueError) as error:
        raise TlsCertificateError(
            f"{path} is not a server certificate ({error}); make one: syntopic certificate"
        ) from error
    alternatives = stated.get("subjectAltName", ())
    return Certificate(
        frozenset(text.lower() for kind, text in alternatives if kind == "DNS"),
        frozenset(str(ip_address(text.strip())) for kind, text in alternatives if kind[:2] == "IP"),
        ssl.cert_time_to_seconds(stated["notBefore"]),
        ssl.cert_time_to_seconds(stated["notAfter"]),
    )


def validity_problem(certificate: Certificate, now_s: float) -> str | None:
    """The reason why clients reject the certificate at this time; None if its dates are valid."""
    if now_s < certificate.begins_s:
        return (
            f"the certificate is valid only from {_date(certificate.begins_s)} on; set the clock "
            "of this machine"
        )
    if now_s > certificate.ends_s:
        return (
            f"the certificate expired on {_date(certificate.ends_s)}, and clients refuse it; renew "
            "it: syntopic certificate"
        )
    return None


def expiry_warning(certificate: Certificate, now_s: float) -> str | None:
    """A warning if the certificate expires within 30 days; else None."""
    left_s = certificate.ends_s - now_s
    if not 0 <= left_s < EXPIRES_SOON_S:
        return None
    return (
        f"the certificate expires in {left_s / 86_400:.0f} days, on {_date(certificate.ends_s)}; "
        "renew it: syntopic certificate"
    )


def name_problem(certificate: Certificate, host: str, names: Collection[str]) -> str | None:
    """Names missing in the certificate, as a message; None if complete.

    Args:
        certificate: of the server.
        host: address that is listened on; a wildcard is every address.
        names: of this machine, of which one suffices.
    """
    if not any(_is_named(certificate, name) for name in names):
        return (
            f"the certificate has none of this machine's names ({', '.join(names)}), and clients "
            "refuse it under them; make one with them: syntopic certificate"
        )
    try:
        address = ip_address(host)
    except ValueError:
        return None
    if address.is_unspecified or str(address) in certificate.addresses:
        return None
    return (
        f"the certificate does not contain {host}, the address of [watch] host, and clients reject "
        "it; make one with this address: syntopic certificate"
    )


def machine_names() -> tuple[str, ...]:
    """The names of this machine: multicast DNS, host name, and fully qualified name."""
    name = socket.gethostname().lower()
    return tuple(dict.fromkeys((f"{name.partition('.')[0]}.local", name, socket.getfqdn().lower())))


class CertificateFiles:
    """The two files, checked periodically; a renewed certificate needs no restart.

    Args:
        certificate: PEM, the server's certificate first.
        key: PEM, its key.
        context: made of both.
    """

    def __init__(self, certificate: Path, key: Path, context: ssl.SSLContext) -> None:
        self._certificate, self._key = certificate, key
        self.context = context
        self._stamps = self._read_stamps()
        self._refused = self._stamps

    def renewed(self) -> bool:
        """Load the files if they changed; whether they are in use.

        Raises:
            TlsCertificateError: they were changed and cannot be used, raised once; `context`
            remains
                the previous one.
        """
        stamps = self._read_stamps()
        if stamps in (self._stamps, self._refused):
            return False
        try:
            context = server_context(self._certificate, self._key)
            read_certificate(self._certificate, context)
        except TlsCertificateError:
            self._refused = stamps
            raise
        self.context, self._stamps = context, stamps
        return True

    def _read_stamps(self) -> tuple[tuple[int, int, int], ...]:
        return tuple(_stamp(path) for path in (self._certificate, self._key))


def _stamp(path: Path) -> tuple[int, int, int]:
    try:
        status = path.stat()
    except OSError:
        return MISSING_FILE_STAMP
    return status.st_ino, status.st_mtime_ns, status.st_mode


def _mode_of_file(path: Path, setting: str) -> int:
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise TlsCertificateError(
            f"{path} cannot be read ({error.strerror}); [watch] {setting} names a PEM file"
        ) from error
    if not stat.S_ISREG(mode):
        raise TlsCertificateError(
            f"{path} is not a regular file; [watch] {setting} names a PEM file"
        )
    return mode


def _is_named(certificate: Certificate, name: str) -> bool:
    """As clients match names: the first label may be a wildcard."""
    return name in certificate.names or f"*.{name.partition('.')[2]}" in certificate.names


def _date(unix_s: float) -> str:
    return time.strftime("%Y-%m-%d", time.gmtime(unix_s))
