"""`syntopic certificate`: TLS for page, API, telemetry and monitor."""

from __future__ import annotations

import grp
import json
import os
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.options import AsJson
from daemon.terminal.console import Console

HELP = """Create a local authority and a TLS certificate for this machine.

The certificate has the machine's names (mDNS and host name), its addresses, and those given with
--name. Install the authority on tablets and ground stations once
(docs/how-to/flight/tls.md); run the command again to renew the certificate, which a running
service uses within seconds.

Examples: `syntopic certificate`, `syntopic certificate --folder tls --name camera1.example.org`
"""
DEFAULT_FOLDER = Path("/etc/syntopic/tls")
SERVICE_GROUP = "syntopic"


def certificate(
    folder: Annotated[
        Path, typer.Option(help="Folder of the certificate and its key.")
    ] = DEFAULT_FOLDER,
    authority: Annotated[
        Path | None, typer.Option(help="Folder of the authority (default: the same).")
    ] = None,
    names: Annotated[
        list[str] | None, typer.Option("--name", help="Further name or IP address; repeatable.")
    ] = None,
    days: Annotated[
        int, typer.Option(help="Validity of the certificate in days.", min=1, max=825)
    ] = 397,
    group: Annotated[
        str | None, typer.Option(help="Group that reads the key (default: syntopic, if it exists).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.onboard.monitoring.access.certificate_authority import issue_certificate

    reader = _gid_of(group)
    issued = issue_certificate(folder, authority=authority, names=names or (), days=days)
    if reader is not None:
        os.chown(issued.key, -1, reader)
    if as_json:
        content = {
            "certificate": str(issued.certificate),
            "key": str(issued.key),
            "authority": str(issued.authority),
            "names": issued.names,
            "authority_sha256": issued.fingerprint,
            "new_authority": issued.is_new_authority,
        }
        typer.echo(json.dumps(content))
        return
    console = Console(soft_wrap=True, highlight=False)
    lines = [
        f"Certificate for {', '.join(issued.names)}.",
        "",
        "In service.toml:",
        "  [watch]",
        f'  tls_certificate = "{issued.certificate.absolute()}"',
        f'  tls_key = "{issued.key.absolute()}"',
        "",
        f"{'New authority' if issued.is_new_authority else 'Authority'}: {issued.authority}; "
        "install it on tablets and ground stations, and compare its SHA-256:",
        f"  {issued.fingerprint}",
        f"Keep {issued.authority.with_suffix('.key')} secret; it is needed only for renewals.",
    ]
    for line in lines:
        console.print(line, markup=False)


def _gid_of(group: str | None) -> int | None:
    """The group that reads the key; None to leave it as it is."""
    from daemon.onboard.monitoring.access.certificates import TlsCertificateError

    if group is None and os.geteuid() != 0:
        return None
    try:
        return grp.getgrnam(group or SERVICE_GROUP).gr_gid
    except KeyError as error:
        if group is None:
            return None
        raise TlsCertificateError(f"there is no group {group!r} on this machine") from error
