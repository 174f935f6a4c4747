"""Announcement of the service as `_syntopic._tcp` by multicast DNS, without a directory.

The text record contains version, rig, mission, phase, and whether commands require a token.
"""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress
from typing import Any

from daemon.configuration.model import WatchSection
from daemon.onboard.monitoring.access.certificate_authority import machine_addresses
from daemon.onboard.monitoring.flight_state import FlightState

SERVICE_TYPE = "_syntopic._tcp.local."
REFRESH_S = 5.0
_TEXT_MAX_BYTES = 200
"""Of a value; key and value together have 255 at most (RFC 6763, section 6.1)."""


class MdnsAnnouncer:
    """Announces the service from start to stop."""

    def __init__(self, state: FlightState, settings: WatchSection, port: int) -> None:
        self._state = state
        self._settings = settings
        self._port = port
        self._zeroconf: Any = None
        self._task: asyncio.Task[None] | None = None

    async def begin(self) -> None:
        """Announce the service and update its text record."""
        if not self._settings.announce:
            return
        from zeroconf import IPVersion
        from zeroconf.asyncio import AsyncZeroconf

        self._zeroconf = AsyncZeroconf(ip_version=IPVersion.V4Only)
        self._task = asyncio.create_task(self._refresh())

    async def end(self) -> None:
        """Withdraw the announcement."""
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        if self._zeroconf is not None:
            await self._zeroconf.async_unregister_all_services()
            await self._zeroconf.async_close()

    async def _refresh(self) -> None:
        info = self._info()
        await self._zeroconf.async_register_service(info, allow_name_change=True)
        published = self._text()
        while True:
            await asyncio.sleep(REFRESH_S)
            if self._text() != published:
                published = self._text()
                info = self._info(name=info.name)
                await self._zeroconf.async_update_service(info)

    def _info(self, name: str | None = None) -> Any:
        from zeroconf import ServiceInfo

        return ServiceInfo(
            SERVICE_TYPE,
            name or f"{socket.gethostname()[:40]}-{self._port}.{SERVICE_TYPE}",
            # Given on registering where it is missing, but not on a change of the text record.
            server=f"{socket.gethostname()[:40]}.local.",
            parsed_addresses=_addresses(self._settings.host),
            port=self._port,
            properties=self._text(),
        )

    def _text(self) -> dict[str, str]:
        brief = self._state.brief()
        mission = brief["mission"]
        return {
            "version": "1",
            "software": _truncated(brief["software"]),
            "rig": _truncated(mission.get("rig") or ""),
            "mission": _truncated(mission.get("id") or ""),
            "phase": str(brief["phase"]),
            "simulated": str(brief["simulated"]).lower(),
            "tls": str(self._settings.tls_certificate is not None).lower(),
            "token": "command" if self._settings.anonymous_read else "all",
        }


def _truncated(text: object) -> str:
    return str(text).encode("utf-8", "replace")[:_TEXT_MAX_BYTES].decode("utf-8", "ignore")


def _addresses(host: str) -> list[str]:
    """The announced addresses: the one listened on, or every IPv4 address of this machine."""
    if host not in ("0.0.0.0", "::", "localhost"):
        return [host]
    found = [address for address in machine_addresses() if ":" not in address]
    beyond = [address for address in found if not address.startswith("127.")]
    return ["127.0.0.1"] if host == "localhost" or not beyond else beyond
