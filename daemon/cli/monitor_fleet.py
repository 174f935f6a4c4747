"""`syntopic monitor --serve`: one page for several aircraft."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from typing import TYPE_CHECKING

from daemon import DaemonError
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from daemon.onboard.monitoring.client.telemetry_client import AccessOptions, ServiceAddress


class FleetError(DaemonError):
    """The page of several aircraft cannot be served; the message contains the reason."""


def serve_fleet(
    listen_at: str,
    services: Sequence[ServiceAddress],
    access: AccessOptions,
    *,
    is_open: bool = False,
) -> None:
    """Serve the page until it is interrupted.

    Args:
        listen_at: HOST:PORT of the page; PORT alone listens on this machine only.
        services: the services of the aircraft.
        access: token and authority for all of them.
        is_open: the page may show beyond this machine what the services show to a token only.

    Raises:
        FleetError: the address of the page is none, too many services are given, or the page would
            be open to other machines although a token is needed to read.
    """
    import uvicorn

    from daemon.onboard.monitoring.client.telemetry_client import check_token_transport
    from daemon.onboard.monitoring.fleet import MEMBERS_MAX, FleetMember, create_fleet_app
    from daemon.onboard.monitoring.web.connections import Connections
    from daemon.onboard.monitoring.web.request_filter import RequestFilter

    host, port = _parse(listen_at)
    if access.token and not _is_loopback(host) and not is_open:
        raise FleetError(
            f"the page at {listen_at} has neither TLS nor tokens; each machine that reaches it "
            "would read what the services show to holders of a token. Serve on 127.0.0.1, behind a "
            "reverse proxy with TLS, or accept that with --serve-without-token"
        )
    if len(services) > MEMBERS_MAX:
        raise FleetError(f"{len(services)} services are given; {MEMBERS_MAX} are possible")
    for service in services:
        check_token_transport(service, access)
    members = [FleetMember(service, access) for service in services]
    for member in members:
        member.start()
    filtered = RequestFilter(create_fleet_app(members), Connections(()), (), lambda _token: False)
    shown = f"[{host}]" if ":" in host else host
    Console().print(f"{len(members)} aircraft on http://{shown}:{port}/", markup=False)
    uvicorn.run(
        filtered, host=host, port=port, log_level="warning", access_log=False, server_header=False
    )


def _parse(listen_at: str) -> tuple[str, int]:
    host, _, port = listen_at.rpartition(":")
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise FleetError(f"{listen_at} is no address; write HOST:PORT or PORT, for example 8480")
    return host.strip("[]") or "127.0.0.1", int(port)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
