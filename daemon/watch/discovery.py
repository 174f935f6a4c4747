"""Being found: the service announced as `_syntopic._tcp` by multicast DNS, without a directory.

The text record tells version, rig, mission, phase, and whether commands need a token.
"""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress
from typing import Any

from daemon.configuration import WatchSection
from daemon.watch.state import FlightState

SERVICE_TYPE = "_syntopic._tcp.local."
REFRESH_S = 5.0
_TEXT_MAX = 200


class Announcement:
    """Announces as long as it is begun; silent on loopback only when told so by zeroconf itself."""

    def __init__(self, state: FlightState, settings: WatchSection, port: int) -> None:
        self._state = state
        self._settings = settings
        self._port = port
        self._zeroconf: Any = None
        self._task: asyncio.Task[None] | None = None

    async def begin(self) -> None:
        """Announce, and keep the text record up to date."""
        if not self._settings.announce:
            return
        from zeroconf import IPVersion
        from zeroconf.asyncio import AsyncZeroconf

        self._zeroconf = AsyncZeroconf(ip_version=IPVersion.V4Only)
        self._task = asyncio.create_task(self._keep())

    async def end(self) -> None:
        """Say good-bye."""
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        if self._zeroconf is not None:
            await self._zeroconf.async_unregister_all_services()
            await self._zeroconf.async_close()

    async def _keep(self) -> None:
        info = self._info()
        await self._zeroconf.async_register_service(info, allow_name_change=True)
        told = self._text()
        while True:
            await asyncio.sleep(REFRESH_S)
            if self._text() != told:
                told = self._text()
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
            "software": str(brief["software"])[:_TEXT_MAX],
            "rig": str(mission.get("rig") or "")[:_TEXT_MAX],
            "mission": str(mission.get("id") or "")[:_TEXT_MAX],
            "phase": str(brief["phase"]),
            "simulated": str(brief["simulated"]).lower(),
            "tls": str(self._settings.certificate is not None).lower(),
            "token": "command" if self._settings.open else "all",
        }


def _addresses(host: str) -> list[str]:
    """What is to be dialled: the address listened on, or every one of this host."""
    if host not in ("0.0.0.0", "::"):
        return [host]
    found = {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None)}
    return sorted(address for address in found if ":" not in address) or ["127.0.0.1"]
