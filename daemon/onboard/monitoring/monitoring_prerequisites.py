"""Prerequisites of monitoring: port, tokens, certificate, keys and addresses.

Looked at by `syntopic check`, and by the watch process at its start, which reports the same
sentences; the flight continues without what fails here.
"""

from __future__ import annotations

import grp
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from daemon import DaemonError
from daemon.configuration.model import WatchSection
from daemon.onboard.monitoring.access.certificates import (
    TlsCertificateError,
    expiry_warning,
    machine_names,
    name_problem,
    read_certificate,
    server_context,
    validity_problem,
)
from daemon.onboard.monitoring.access.tokens import TokenError, read_tokens
from daemon.onboard.monitoring.maps.map_library import check_maps
from daemon.onboard.monitoring.mavlink.signatures import read_key
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult, failed, passed


class WatchError(DaemonError):
    """Monitoring is not possible; the message contains the reason and the corrective action."""


def check_monitoring(settings: WatchSection, *, port: bool = True) -> Iterator[CheckResult]:
    """Check each prerequisite.

    Args:
        settings: `[watch]` of the configuration.
        port: whether the port is tried, which holds it for a moment.
    """
    if port:
        yield _port(settings)
    yield from _tokens(settings.tokens)
    yield from _certificate(settings)
    yield from _control(settings)
    yield from _signing_key(settings)
    yield from check_maps(settings.maps)


def listen(host: str, port: int) -> socket.socket:
    """A listening TCP socket.

    Raises:
        WatchError: the address is taken, or none of this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen(64)
    except OSError as error:
        listening.close()
        raise WatchError(
            f"port {port} of {host} cannot be used ({error.strerror or error}); end the program "
            "that holds it, or configure another ([watch] port). Monitoring is not possible"
        ) from error
    return listening


def _port(settings: WatchSection) -> CheckResult:
    try:
        listen(settings.host, settings.port).close()
    except WatchError as error:
        return failed("watch", "watch", str(error))
    return passed("watch", "watch", f"{settings.host}:{settings.port}")


def _tokens(path: Path | None) -> Iterator[CheckResult]:
    if path is None:
        return
    try:
        tokens = read_tokens(path)
    except TokenError as error:
        yield failed("watch", "tokens", f"{error}; no commands with a token")
        return
    if not path.exists():
        sentence = f"no tokens yet; create one: syntopic token add NAME --file {path}"
        yield passed("watch", "tokens", sentence)
        return
    yield passed("watch", "tokens", f"{len(tokens.holders)} holders")


def _certificate(settings: WatchSection) -> Iterator[CheckResult]:
    """Check that a certificate is usable and that clients accept it."""
    path, key = settings.tls_certificate, settings.tls_key
    if path is None or key is None:
        return
    try:
        certificate = read_certificate(path, server_context(path, key))
    except TlsCertificateError as error:
        yield failed("watch", "certificate", f"{error}. Monitoring is not possible")
        return
    yield passed("watch", "certificate")
    now_s = time.time()
    problem = validity_problem(certificate, now_s) or name_problem(
        certificate, settings.host, machine_names()
    )
    if problem is not None:
        yield failed("watch", "certificate for clients", problem)
    elif (warning := expiry_warning(certificate, now_s)) is not None:
        yield CheckResult("watch", "certificate for clients", CheckOutcome.WAITING, warning)
    else:
        yield passed("watch", "certificate for clients")


def _control(settings: WatchSection) -> Iterator[CheckResult]:
    path = settings.control
    if path is None:
        return
    groups = settings.control_group, settings.control_administrator_group
    known = {one.gr_name for one in grp.getgrall()}
    unknown = [group for group in groups if group is not None and group not in known]
    if unknown:
        sentence = (
            f"there is no group {unknown[0]!r}; [watch] control_group and "
            "control_administrator_group name groups of this machine"
        )
        yield failed("watch", "control", sentence)
    elif not path.parent.is_dir():
        sentence = f"{path.parent} is not a folder; [watch] control names a path in a folder"
        yield failed("watch", "control", sentence)
    elif path.exists() and not stat.S_ISSOCK(path.lstat().st_mode):
        yield failed("watch", "control", f"{path} exists and is not a socket; remove it")
    else:
        yield passed("watch", "control")


def _signing_key(settings: WatchSection) -> Iterator[CheckResult]:
    key = None if settings.mavlink is None else settings.mavlink.signing_key
    if key is None:
        return
    try:
        read_key(key)
    except ValueError as error:
        yield failed("watch", "mavlink camera", f"{error}. No MAVLink camera is announced")
    else:
        yield passed("watch", "mavlink camera")
