"""Telemetry client for the network.

The address given by the user determines TLS and the receiver of a token; no announcement,
redirect or proxy does.
"""

from __future__ import annotations

import re
import socket
import ssl
import time
from collections.abc import Iterator
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from daemon import DaemonError
from daemon.terminal.printable import printable, printable_tree
from drivers.base.extras import require

DEFAULT_PORT: Final = 8470
RECEIVE_TIMEOUT_S: Final = 10.0
OPEN_TIMEOUT_S: Final = 10.0
RETRY_S: Final = 1.0
RECORD_MAX_BYTES: Final = 4_000_000
"""The service sends two seconds of the budget at most."""
_SCHEMES: Final = {"": None, "http": False, "ws": False, "https": True, "wss": True}
_HOST = re.compile(r"[A-Za-z0-9.\-_:%]{1,255}")
_TOKEN = re.compile(r"[A-Za-z0-9._~+/=\-]{1,200}")


class ClientError(DaemonError):
    """No service can be monitored; the message contains the reason."""


@dataclass(frozen=True)
class ServiceAddress:
    """Address of a service, and whether it uses TLS."""

    host: str
    port: int
    is_tls: bool

    @property
    def address(self) -> str:
        """The address as a URL."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.is_tls else 'http'}://{host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """Whether the address is on this machine."""
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return self.host.lower() == "localhost"


@dataclass(frozen=True)
class AccessOptions:
    """Access parameters of a service.

    Attributes:
        token: sent in a header; none if empty.
        authority: PEM of the authority to trust; those of the system if None.
        is_token_public: send the token without TLS, too.
    """

    token: str = ""
    authority: Path | None = None
    is_token_public: bool = False


def parse_service_address(text: str, *, tls: bool = False) -> ServiceAddress:
    """The service at HOST:PORT or a URL; the scheme decides about TLS, else `tls`.

    Raises:
        ClientError: no address, or one that contradicts `tls`.
    """
    scheme, separator, rest = text.partition("://")
    if not separator:
        scheme, rest = "", text
    shown = printable(text, 100)
    if scheme.lower() not in _SCHEMES:
        raise ClientError(f"{shown}: write HOST:PORT, https://HOST:PORT or http://HOST:PORT")
    try:
        parts = urlsplit(f"//{rest}")
        host, port = parts.hostname or "", parts.port or DEFAULT_PORT
    except ValueError as error:
        raise ClientError(f"{shown} is no address ({error}); write HOST:PORT") from error
    if parts.username is not None or parts.query or parts.path not in ("", "/"):
        raise ClientError(
            f"{parts.hostname or 'the address'}: give host and port only; a token belongs into "
            "SYNTOPIC_TOKEN or --token"
        )
    if not _HOST.fullmatch(host):
        raise ClientError(f"{shown} is no address; write HOST:PORT")
    by_scheme = _SCHEMES[scheme.lower()]
    if by_scheme is False and tls:
        raise ClientError(f"{shown} has no TLS, and --tls requires it; write https://")
    return ServiceAddress(host, port, tls if by_scheme is None else by_scheme)


def check_token_transport(service: ServiceAddress, access: AccessOptions) -> None:
    """Check that a token may be sent to a service.

    Raises:
        ClientError: it is no token, or it would travel unencrypted beyond this machine.
    """
    if access.token and not _TOKEN.fullmatch(access.token):
        raise ClientError("the token contains invalid characters; copy it again")
    may_be_read = not service.is_tls and not service.is_loopback
    if access.token and may_be_read and not access.is_token_public:
        raise ClientError(
            f"{service.address}: without TLS the token can be read in transit; use "
            f"https:// (or --tls), or accept that with --token-without-tls"
        )


def telemetry_records(
    service: ServiceAddress, access: AccessOptions, bytes_per_s: float
) -> Iterator[dict[str, Any] | None]:
    """Telemetry for ever, with printable texts; None when the connection is lost. It is retried.

    Raises:
        ClientError: the first link could not be opened, or what came is no telemetry.
    """
    require("watch")
    import msgpack
    from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage

    check_token_transport(service, access)
    context = _context(access) if service.is_tls else None
    has_received = False
    while True:
        try:
            with _connect(service, access, context, bytes_per_s) as websocket:
                while True:
                    data = websocket.recv(timeout=RECEIVE_TIMEOUT_S)
                    yield _record(data)
                    has_received = True
        except (
            *(ConnectionClosed, InvalidHandshake, InvalidMessage, OSError, TimeoutError, EOFError),
            *(ValueError, TypeError, RecursionError, msgpack.UnpackException),
        ) as error:
            if not has_received:
                raise ClientError(f"{service.address}: {_reason(error)}") from error
            yield None
            time.sleep(RETRY_S)


def _connect(
    service: ServiceAddress,
    access: AccessOptions,
    context: ssl.SSLContext | None,
    bytes_per_s: float,
) -> Any:
    """An open WebSocket, without redirects and proxies."""
    from websockets.sync.client import connect

    opened = socket.create_connection((service.host, service.port), OPEN_TIMEOUT_S)
    host = f"[{service.host}]" if ":" in service.host else service.host
    query = f"form=msgpack&bytes_per_s={bytes_per_s:.0f}"
    try:
        return connect(
            f"{'wss' if service.is_tls else 'ws'}://{host}:{service.port}/api/v1/telemetry?{query}",
            sock=opened,
            ssl=context,
            additional_headers={"Authorization": f"Bearer {access.token}"} if access.token else {},
            open_timeout=OPEN_TIMEOUT_S,
            max_size=RECORD_MAX_BYTES,
        )
    except BaseException:
        opened.close()
        raise


def _context(access: AccessOptions) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=access.authority)
    except (OSError, ValueError) as error:
        raise ClientError(
            f"{access.authority} cannot be read ({error}); --authority names the PEM file of the "
            "authority (authority.pem of syntopic certificate)"
        ) from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context


def _record(data: bytes | str) -> dict[str, Any]:
    import msgpack

    if isinstance(data, str):
        raise ValueError("a text where a record was expected")
    content = printable_tree(msgpack.unpackb(data, ext_hook=_no_extension))
    if not isinstance(content, dict):
        raise ValueError(f"a record is a map, not a {type(content).__name__}")
    return content


def _no_extension(code: int, _data: bytes) -> Any:
    raise ValueError(f"extension type {code} in it")


def _reason(error: BaseException) -> str:
    """Reason and corrective action for a failed connection, with printable characters only."""
    from websockets.exceptions import ConnectionClosed, InvalidStatus

    if isinstance(error, ssl.SSLCertVerificationError):
        why = printable(error.verify_message, 100)
        return (
            f"its certificate is not accepted ({why}). Give the authority that signed it with "
            "--authority, and a name or address that the certificate has; where it expired, renew "
            "it there (syntopic certificate)"
        )
    if isinstance(error, ssl.SSLError):
        return (
            f"no TLS ({printable(str(error), 100)}); if the service has no certificate, write "
            "http://"
        )
    if isinstance(error, InvalidStatus):
        status = error.response.status_code
        if status in (401, 403):
            return f"refused with status {status}; reading may need a token (SYNTOPIC_TOKEN)"
        reason = printable((error.response.body or b"").decode("utf-8", "replace"), 160)
        return f"refused with status {status}: {reason}"
    if isinstance(error, ConnectionClosed):
        reason = printable(error.rcvd.reason if error.rcvd else "it closed the connection", 160)
        return f"no telemetry ({reason}); check the address, and whether reading requires a token"
    if isinstance(error, OSError):
        return f"no connection ({printable(str(error), 160)}); check the address"
    return f"sends no telemetry ({printable(str(error), 160)}); check the address"
