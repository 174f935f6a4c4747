"""Address and TLS files of a cluster's scheduler; encryption is required off this machine."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from daemon.configuration.model import ConfigurationError

SCHEMES = ("tcp", "tls")


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
            that are missing.
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
    return address


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
