"""The watch process: hears the service, keeps the state, serves the page, the API and telemetry."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from daemon.configuration.model import ConfigurationError, MountSection, PlanSection, WatchSection
from daemon.errors import DaemonError
from daemon.mission.exposure import navigation_from_json
from daemon.mission.layout import Mission
from daemon.mission.records import RecordError
from daemon.onboard.monitoring.access.certificates import (
    CertificateError,
    CertificateFiles,
    server_context,
)
from daemon.onboard.monitoring.access.control_socket import ControlError, ControlSocket
from daemon.onboard.monitoring.access.gate import Gate
from daemon.onboard.monitoring.access.tokens import TokenError, Tokens, read_tokens
from daemon.onboard.monitoring.client.discovery import Announcement
from daemon.onboard.monitoring.confinement import confine
from daemon.onboard.monitoring.coverage import Coverage
from daemon.onboard.monitoring.earlier import remember
from daemon.onboard.monitoring.mavlink.camera import MavlinkCamera
from daemon.onboard.monitoring.mavlink.datagrams import send
from daemon.onboard.monitoring.pictures import pictures_of
from daemon.onboard.monitoring.prerequisites import WatchError, listen, watch_findings
from daemon.onboard.monitoring.protocols import (
    MESSAGE_MAX_BYTES,
    FewLines,
    LimitedHttp,
    LimitedWebSocket,
)
from daemon.onboard.monitoring.state import FlightState
from daemon.onboard.monitoring.web.api import WatchSettings, create_app
from daemon.onboard.monitoring.web.connections import Connections, ListeningSocket
from daemon.onboard.monitoring.web.guard import Application, Guard, Occupancy
from daemon.onboard.monitoring.web.listener import Listener
from daemon.onboard.preflight.findings import Outcome
from daemon.onboard.service.messages import Answer, Ping, Pong, Stop, Told
from daemon.onboard.service.page_link import PageLink
from daemon.onboard.service.processes import ServiceGoneError
from daemon.orientation.exterior import mount_of
from daemon.orientation.footprints import seen_from
from drivers.base.extras import MissingExtraError
from processing.rig import Rig, RigError, load_rig

GATHER_S = 10.0
RENEWAL_S = 5.0
"""How often the certificate's files are looked at."""

PING_S, PONG_WITHIN_S = 5.0, 10.0
"""So often a watcher is asked whether it still listens, and has so long to answer: what the kernel
holds for one that stalls may be minutes of telemetry."""


def main(link: PageLink, settings: WatchSection, plan: PlanSection | None = None) -> None:
    """Serve watchers until told to stop; `plan` names files that a mission may not."""
    confine()
    logging.getLogger("uvicorn.error").addFilter(FewLines())
    asyncio.run(_serve(link, settings, plan or PlanSection()))


async def _serve(link: PageLink, settings: WatchSection, plan: PlanSection) -> None:
    ground = _Ground()
    state = FlightState(f"syntopic {version('syntopic')}", ground.seen_from, pictures_of)
    ground.state = state
    failing = set()
    for finding in watch_findings(settings, port=False):
        if finding.outcome is Outcome.FAIL:
            failing.add(finding.name)
            link.send(Told(_absent(finding.name, finding.sentence)))
    gate = Gate(link.send)
    coverage = Coverage(state, plan)
    watchers = WatchSettings(_tokens(settings.tokens), settings.open)
    connections = Connections(settings.proxies)
    app = create_app(state, gate, watchers, coverage, connections)
    certified = "certificate" not in failing
    files = _certificate_files(settings) if certified else None
    server = _Server(
        uvicorn.Config(
            _guarded(app, settings, watchers.tokens, connections),
            log_level="warning",
            access_log=False,
            lifespan="off",
            http=LimitedHttp,
            ws=LimitedWebSocket,
            ws_max_size=MESSAGE_MAX_BYTES,
            proxy_headers=False,
            server_header=False,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PONG_WITHIN_S,
            timeout_graceful_shutdown=1,
        ),
        files,
    )
    listening, port = None, settings.port
    try:
        listening = listen(settings.host, settings.port) if certified else None
    except WatchError as error:
        link.send(Told(_absent("watch", str(error))))
    if listening is not None:
        listening = ListeningSocket(listening, connections)
        port = int(listening.getsockname()[1])
        told = {"host": settings.host, "port": port, "tls": files is not None}
        link.send(Told({"event": "watching", **told}))
    ending = asyncio.Event()
    announcement = Announcement(state, settings, port)
    saying = asyncio.create_task(send(state, settings.udp_addresses, settings.udp_bytes_per_s))
    gathering = asyncio.create_task(_gather(coverage))
    sweeping = asyncio.create_task(connections.keep_sweeping())
    renewing = asyncio.create_task(_renew(files, link))
    camera = control = None
    if "mavlink camera" not in failing:
        camera = await _camera(settings, state, gate, ground, link)
    if "control" not in failing:
        control = await _control(settings, state, gate, link)
    loop = asyncio.get_running_loop()
    remembering: set[asyncio.Task[None]] = set()

    def recall(path: str) -> None:
        remembering.add(loop.create_task(remember(state, Path(path), coverage.gather)))

    loop.add_reader(link.fileno(), _hear, link, state, gate, ending, recall)
    serving = (
        asyncio.create_task(server.serve(sockets=[listening])) if listening is not None else None
    )
    try:
        with suppress(OSError):
            await announcement.begin()
        await ending.wait()
    finally:
        loop.remove_reader(link.fileno())
        server.should_exit = True
        saying.cancel()
        gathering.cancel()
        sweeping.cancel()
        renewing.cancel()
        for task in remembering:
            task.cancel()
        if camera is not None:
            camera.end()
        if control is not None:
            control.end()
        with suppress(OSError):
            await announcement.end()
        if serving is not None:
            with suppress(TimeoutError):
                await asyncio.wait_for(serving, 3.0)


def _guarded(
    app: FastAPI, settings: WatchSection, tokens: Tokens, connections: Connections
) -> Application:
    """The application behind what every request passes first, outermost last."""

    def is_known(token: str) -> bool:
        return tokens.holder_of(token) is not None

    guarded: Any = Guard(app, connections, settings.hosts, is_known)
    if settings.proxies:
        guarded = ProxyHeadersMiddleware(guarded, list(settings.proxies))
    return Occupancy(guarded, connections)


class _Server(uvicorn.Server):
    """Ends when the service says so: signals of the whole process group are the service's.

    Connections are accepted by a `Listener`, with TLS where there are certificate files.
    """

    def __init__(self, config: uvicorn.Config, files: CertificateFiles | None) -> None:
        super().__init__(config)
        self._files = files
        self._listeners: list[Listener] = []

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        files = self._files
        context = None if files is None else lambda: files.context
        self._listeners = [Listener(one, self._protocol, context) for one in sockets or []]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for listener in self._listeners:
            listener.close()
        await super().shutdown(sockets)

    def _protocol(self) -> asyncio.Protocol:
        made: asyncio.Protocol = self.config.http_protocol_class(  # type: ignore[call-arg]
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        return made


def _certificate_files(settings: WatchSection) -> CertificateFiles | None:
    if settings.tls_certificate is None or settings.tls_key is None:
        return None
    context = server_context(settings.tls_certificate, settings.tls_key)
    return CertificateFiles(settings.tls_certificate, settings.tls_key, context)


async def _renew(files: CertificateFiles | None, link: PageLink) -> None:
    """Use a renewed certificate without a restart; connections that are open keep theirs."""
    while files is not None:
        await asyncio.sleep(RENEWAL_S)
        try:
            if not files.renewed():
                continue
            problem = ""
        except CertificateError as error:
            problem = f"{error}. The previous certificate is still used"
        sentence = problem or "the renewed certificate is used from now on"
        event = {"event": "tls-certificate", "fault": bool(problem), "sentence": sentence}
        link.send(Told(event))


async def _gather(coverage: Coverage) -> None:
    """Coverage hears of every exposure, whether anybody asks or not."""
    while True:
        coverage.gather()
        await asyncio.sleep(GATHER_S)


async def _camera(
    settings: WatchSection, state: FlightState, gate: Gate, ground: _Ground, link: PageLink
) -> MavlinkCamera | None:
    """The rig as a camera of the vehicle, where that is wanted and possible."""
    if settings.mavlink is None:
        return None

    def report(sentence: str) -> None:
        link.send(Told({"event": "signing-state", "sentence": sentence}))

    try:
        camera = MavlinkCamera(
            settings.mavlink, state, gate, lambda: ground.rig, lambda: ground.height_m, report
        )
        await camera.begin()
    except (MissingExtraError, OSError, ValueError) as error:
        sentence = f"no MAVLink camera: {error}; look at [watch.mavlink]"
        link.send(Told(_absent("mavlink camera", sentence)))
        return None
    return camera


async def _control(
    settings: WatchSection, state: FlightState, gate: Gate, link: PageLink
) -> ControlSocket | None:
    """The Unix socket for commands, where that is wanted and possible."""
    if settings.control is None:
        return None

    groups = settings.control_group, settings.control_administrator_group
    try:
        control = ControlSocket(settings.control, *groups, gate, state)
        await control.begin()
    except ControlError as error:
        link.send(Told(_absent("control", f"no commands over the Unix socket: {error}")))
        return None
    return control


class _Ground:
    """Footprints for the map, once it is known which rig flies and how it is mounted."""

    def __init__(self) -> None:
        self.state: FlightState | None = None
        self._of: str | None = None
        self._known: tuple[Rig, MountSection, float] | None = None

    @property
    def rig(self) -> Rig | None:
        """The rig that flies, once that is known."""
        known = self._look()
        return None if known is None else known[0]

    @property
    def height_m(self) -> float | None:
        """Of the ground, as planned."""
        known = self._look()
        return None if known is None else known[2]

    def _look(self) -> tuple[Rig, MountSection, float] | None:
        path = self.state.mission_path if self.state else None
        if path is not None and path != self._of:
            self._of = path
            self._known = _rig_and_ground(Path(path))
        return self._known

    def seen_from(self, navigation: Mapping[str, Any]) -> list[list[float]] | None:
        """Corners [latitude, longitude] of an exposure; None where they are not to be had."""
        known = self._look()
        if known is None:
            return None
        rig, mount, ground_m = known
        try:
            corners = seen_from(rig, mount, navigation_from_json(navigation), ground_m)
        except RecordError:
            return None
        return (
            None if corners is None else [[latitude, longitude] for longitude, latitude in corners]
        )


def _rig_and_ground(path: Path) -> tuple[Rig, MountSection, float] | None:
    try:
        mission = Mission.open(path)
        mount, plan = mount_of(mission)
        return load_rig(mission.rig_path), mount, plan.ground_height_m
    except (OSError, DaemonError, ConfigurationError, RigError):
        return None


def _hear(
    link: PageLink,
    state: FlightState,
    gate: Gate,
    ending: asyncio.Event,
    recall: Callable[[str], None],
) -> None:
    """Everything the service has said."""
    try:
        while (message := link.receive(0.0)) is not None:
            if isinstance(message, Told):
                state.apply(message.event)
                if message.event.get("event") == "mission":
                    recall(str(message.event.get("path")))
            elif isinstance(message, Answer):
                gate.answered(message)
            elif isinstance(message, Ping):
                link.send(Pong({}))
            elif isinstance(message, Stop):
                ending.set()
                return
    except ServiceGoneError:
        ending.set()


def _absent(device: str, sentence: str) -> dict[str, Any]:
    return {
        "event": "device",
        "device": device,
        "name": "absent",
        "fault": True,
        "sentence": sentence,
    }


def _tokens(path: Path | None) -> Tokens:
    try:
        return read_tokens(path)
    except TokenError:
        return Tokens({})  # reported with the prerequisites
