"""Address and TLS files of a cluster's scheduler; encryption is required off this machine."""

from __future__ import annotations

import ipaddress
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from daemon.configuration.model import ConfigurationError

SCHEMES = ("tcp", "tls")
HANDSHAKE_TIMEOUT_S = 3.0


@dataclass(frozen=True)
class ClusterAddress:
    """Where a scheduler listens, and the files that prove who connects.

    `ca`, `certificate` and `key` are PEM files; all three for tls://, none for tcp://.
    """

    url: str
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    @property
    def is_encrypted(self) -> bool:
        return self.url.startswith("tls://")

    @property
    def is_loopback(self) -> bool:
        return is_loopback(urlsplit(self.url).hostname or "")

    def context(self) -> ssl.SSLContext:
        """How this side proves itself and checks the other one; host names are not compared.

        Raises:
            OSError: a file is no certificate, or the key is of another one.
        """
        context = ssl.create_default_context(cafile=self.ca)
        context.check_hostname = False
        context.load_cert_chain(str(self.certificate), self.key)
        return context


def cluster_address(
    url: str, ca: Path | None, certificate: Path | None, key: Path | None
) -> ClusterAddress:
    """Check the address of a scheduler.

    Args:
        url: such as tcp://127.0.0.1:8786.
        ca: certificate of the authority.
        certificate: of this side.
        key: of the certificate.

    Raises:
        ConfigurationError: no such address, an unencrypted one off this machine, or TLS files
            that are missing or do not belong together.
    """
    parts = urlsplit(url)
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme not in SCHEMES or not parts.hostname or port is None:
        raise ConfigurationError(
            [f"--scheduler {url!r} is no address; tcp://127.0.0.1:8786 or tls://host:8786 is right"]
        )
    address = ClusterAddress(url, ca, certificate, key)
    if not address.is_encrypted:
        if not address.is_loopback:
            raise ConfigurationError(
                [
                    f"{url} leaves this machine without TLS, and a cluster executes what it is "
                    f"sent. Start the scheduler with TLS and give --scheduler "
                    f"tls://{parts.netloc} with --tls-ca, --tls-certificate and --tls-key"
                ]
            )
        if given := given_tls_options(ca, certificate, key):
            raise ConfigurationError(
                [f"{given} has no effect on {url}, which is without TLS; give tls://{parts.netloc}"]
            )
        return address
    problems = [
        f"{url} needs {option} FILE"
        if path is None
        else f"{option} {path}: no such file; give the PEM file"
        for option, path in (
            ("--tls-ca", ca),
            ("--tls-certificate", certificate),
            ("--tls-key", key),
        )
        if path is None or not path.is_file()
    ]
    if problems:
        raise ConfigurationError(problems)
    try:
        address.context()
    except OSError as error:
        raise ConfigurationError(
            [
                f"--tls-ca, --tls-certificate and --tls-key cannot be used together: {error}. "
                "Give PEM files, and the key of this certificate"
            ]
        ) from error
    return address


def given_tls_options(ca: Path | None, certificate: Path | None, key: Path | None) -> str:
    """Names of the TLS options that were given; empty without one.

    Args:
        ca: certificate of the authority.
        certificate: of this side.
        key: of the certificate.
    """
    options = (("--tls-ca", ca), ("--tls-certificate", certificate), ("--tls-key", key))
    return ", ".join(option for option, path in options if path is not None)


def certificate_problem(address: ClusterAddress) -> str:
    """Whether a scheduler that listens and this side refuse each other's certificate.

    Args:
        address: of the scheduler.

    Returns:
        A sentence; empty where they do not, or nothing listens.
    """
    if not address.is_encrypted:
        return ""
    parts = urlsplit(address.url)
    try:
        with (
            socket.create_connection(
                (parts.hostname or "", parts.port or 0), HANDSHAKE_TIMEOUT_S
            ) as connection,
            address.context().wrap_socket(connection) as encrypted,
        ):
            encrypted.recv(1)  # in TLS 1.3 a refused certificate is reported here
    except ssl.SSLError:
        return (
            f"{address.url} and this command do not accept each other's certificate. Both are "
            "signed by the authority of --tls-ca, and valid by the clocks of both machines"
        )
    except OSError:
        return ""
    return ""


def is_loopback(host: str) -> bool:
    """Whether a host is this machine by its name alone; no name is resolved.

    Args:
        host: name or address.
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
