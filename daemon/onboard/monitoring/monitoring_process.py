"""The monitoring process: receives events, holds the state, serves page, API and telemetry."""

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

from daemon import DaemonError
from daemon.configuration.model import MountSection, PlanSection, WatchSection
from daemon.mission.canonical_json import RecordError
from daemon.mission.exposure import navigation_from_json
from daemon.mission.layout import Mission
from daemon.onboard.monitoring.access.certificates import (
    CertificateFiles,
    TlsCertificateError,
    server_context,
)
from daemon.onboard.monitoring.access.command_gateway import CommandGateway
from daemon.onboard.monitoring.access.control_socket import ControlError, ControlSocket
from daemon.onboard.monitoring.access.tokens import TokenError, Tokens, read_tokens
from daemon.onboard.monitoring.backfill import backfill_exposures
from daemon.onboard.monitoring.client.mdns_announcer import MdnsAnnouncer
from daemon.onboard.monitoring.coverage import Coverage
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.http_limits import (
    MESSAGE_MAX_BYTES,
    LimitedHttp,
    LimitedWebSocket,
    RateLimitFilter,
)
from daemon.onboard.monitoring.maps.map_library import MapLibrary
from daemon.onboard.monitoring.mavlink.camera import MavlinkCamera
from daemon.onboard.monitoring.mavlink.datagrams import send
from daemon.onboard.monitoring.monitoring_prerequisites import WatchError, check_monitoring, listen
from daemon.onboard.monitoring.previews import read_preview
from daemon.onboard.monitoring.process_restrictions import apply_resource_limits
from daemon.onboard.monitoring.web.api import AccessSettings, create_app
from daemon.onboard.monitoring.web.connections import Connections, ListeningSocket
from daemon.onboard.monitoring.web.listener import ConnectionListener
from daemon.onboard.monitoring.web.request_filter import (
    Application,
    ConnectionTracker,
    RequestFilter,
)
from daemon.onboard.preflight.check_results import CheckOutcome
from daemon.onboard.service.messages import Answer, Ping, Pong, ServiceEvent, Stop
from daemon.onboard.service.page_connection import PageConnection
from daemon.onboard.service.processes import ServiceDisconnectedError
from daemon.orientation.exterior_orientation import mount_of
from daemon.orientation.footprints import footprint_corners
from drivers.base.extras import MissingExtraError
from processing.rig import Rig, RigError, load_rig

COVERAGE_UPDATE_S = 10.0
RENEWAL_S = 5.0
"""Interval at which the certificate files are checked."""

PING_S, PONG_TIMEOUT_S = 5.0, 10.0
"""Interval and timeout of pings; the kernel may buffer minutes of telemetry for a stalled
client."""


def main(link: PageConnection, settings: WatchSection, plan: PlanSection | None = None) -> None:
    """Serve clients until the service stops it; `plan` names files that a mission may not."""
    apply_resource_limits()
    logging.getLogger("uvicorn.error").addFilter(RateLimitFilter())
    asyncio.run(_serve(link, settings, plan or PlanSection()))


async def _serve(link: PageConnection, settings: WatchSection, plan: PlanSection) -> None:
    ground = _MissionGeometry()
    state = FlightState(f"syntopic {version('syntopic')}", ground.footprint_corners, read_preview)
    ground.state = state
    failing = set()
    for result in check_monitoring(settings, port=False):
        if result.outcome is CheckOutcome.FAIL:
            failing.add(result.name)
            link.send(ServiceEvent(_absent_event(result.name, result.sentence)))
    gateway = CommandGateway(link.send)
    coverage = Coverage(state, plan)
    watchers = AccessSettings(_tokens(settings.tokens), settings.anonymous_read)
    connections = Connections(settings.proxies)
    maps = MapLibrary(settings.maps, plan)
    app = create_app(state, gateway, watchers, coverage, connections, maps)
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
            ws_ping_timeout=PONG_TIMEOUT_S,
            timeout_graceful_shutdown=1,
        ),
        files,
    )
    listening, port = None, settings.port
    try:
        listening = listen(settings.host, settings.port) if certified else None
    except WatchError as error:
        link.send(ServiceEvent(_absent_event("watch", str(error))))
    if listening is not None:
        listening = ListeningSocket(listening, connections)
        port = int(listening.getsockname()[1])
        endpoint = {"host": settings.host, "port": port, "tls": files is not None}
        link.send(ServiceEvent({"event": "watching", **endpoint}))
    stopped = asyncio.Event()
    announcement = MdnsAnnouncer(state, settings, port)
    sending = asyncio.create_task(send(state, settings.udp_addresses, settings.udp_bytes_per_s))
    updating_coverage = asyncio.create_task(_update_coverage(coverage))
    sweeping = asyncio.create_task(connections.run_sweeps())
    renewing = asyncio.create_task(_renew(files, link))
    camera = control = None
    if "mavlink camera" not in failing:
        camera = await _camera(settings, state, gateway, ground, link)
    if "control" not in failing:
        control = await _control(settings, state, gateway, link)
    loop = asyncio.get_running_loop()
    backfills: set[asyncio.Task[None]] = set()

    def start_backfill(path: str) -> None:
        backfills.add(loop.create_task(backfill_exposures(state, Path(path), coverage.update)))

    loop.add_reader(link.fileno(), _receive, link, state, gateway, stopped, start_backfill)
    serving = (
        asyncio.create_task(server.serve(sockets=[listening])) if listening is not None else None
    )
    try:
        with suppress(OSError):
            await announcement.begin()
        await stopped.wait()
    finally:
        loop.remove_reader(link.fileno())
        server.should_exit = True
        sending.cancel()
        updating_coverage.cancel()
        sweeping.cancel()
        renewing.cancel()
        for task in backfills:
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
    """The application with its request filters, outermost last."""

    def is_authenticated(token: str) -> bool:
        return tokens.holder_of(token) is not None

    guarded: Any = RequestFilter(app, connections, settings.hosts, is_authenticated)
    if settings.proxies:
        guarded = ProxyHeadersMiddleware(guarded, list(settings.proxies))
    return ConnectionTracker(guarded, connections)


class _Server(uvicorn.Server):
    """Ends on request of the service, which handles the signals of the process group.

    A `Listener` accepts connections, with TLS if certificate files are configured.
    """

    def __init__(self, config: uvicorn.Config, files: CertificateFiles | None) -> None:
        super().__init__(config)
        self._files = files
        self._listeners: list[ConnectionListener] = []

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        files = self._files
        context = None if files is None else lambda: files.context
        self._listeners = [
            ConnectionListener(one, self._protocol, context) for one in sockets or []
        ]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for listener in self._listeners:
            listener.close()
        await super().shutdown(sockets)

    def _protocol(self) -> asyncio.Protocol:
        # uvicorn declares the class of protocols as one without arguments.
        made: asyncio.Protocol = self.config.http_protocol_class(  # type: ignore[call-arg]
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        return made


def _certificate_files(settings: WatchSection) -> CertificateFiles | None:
    if settings.tls_certificate is None or settings.tls_key is None:
        return None
    context = server_context(settings.tls_certificate, settings.tls_key)
    return CertificateFiles(settings.tls_certificate, settings.tls_key, context)


async def _renew(files: CertificateFiles | None, link: PageConnection) -> None:
    """Use a renewed certificate without a restart; open connections keep the previous one."""
    while files is not None:
        await asyncio.sleep(RENEWAL_S)
        try:
            if not files.renewed():
                continue
            problem = ""
        except TlsCertificateError as error:
            problem = f"{error}. The previous certificate is still used"
        sentence = problem or "the renewed certificate is in use"
        event = {"event": "tls-certificate", "fault": bool(problem), "sentence": sentence}
        link.send(ServiceEvent(event))


async def _update_coverage(coverage: Coverage) -> None:
    """Update the coverage with every exposure, also without a request."""
    while True:
        coverage.update()
        await asyncio.sleep(COVERAGE_UPDATE_S)


async def _camera(
    settings: WatchSection,
    state: FlightState,
    gateway: CommandGateway,
    ground: _MissionGeometry,
    link: PageConnection,
) -> MavlinkCamera | None:
    """The rig as a MAVLink camera, if configured and possible."""
    if settings.mavlink is None:
        return None

    def report(sentence: str) -> None:
        link.send(ServiceEvent({"event": "signing-state", "sentence": sentence}))

    try:
        camera = MavlinkCamera(
            settings.mavlink, state, gateway, lambda: ground.rig, lambda: ground.height_m, report
        )
        await camera.begin()
    except (MissingExtraError, OSError, ValueError) as error:
        sentence = f"no MAVLink camera: {error}; check [watch.mavlink]"
        link.send(ServiceEvent(_absent_event("mavlink camera", sentence)))
        return None
    return camera


async def _control(
    settings: WatchSection, state: FlightState, gateway: CommandGateway, link: PageConnection
) -> ControlSocket | None:
    """The Unix socket for commands, if configured and possible."""
    if settings.control is None:
        return None

    groups = settings.control_group, settings.control_administrator_group
    try:
        control = ControlSocket(settings.control, *groups, gateway, state)
        await control.begin()
    except ControlError as error:
        link.send(
            ServiceEvent(_absent_event("control", f"no commands over the Unix socket: {error}"))
        )
        return None
    return control


class _MissionGeometry:
    """Footprints for the map, after the rig and its mounting are known."""

    def __init__(self) -> None:
        self.state: FlightState | None = None
        self._path: str | None = None
        self._geometry: tuple[Rig, MountSection, float] | None = None

    @property
    def rig(self) -> Rig | None:
        """The rig of the mission; None before it is known."""
        geometry = self._load()
        return None if geometry is None else geometry[0]

    @property
    def height_m(self) -> float | None:
        """Planned height of the ground."""
        geometry = self._load()
        return None if geometry is None else geometry[2]

    def _load(self) -> tuple[Rig, MountSection, float] | None:
        path = self.state.mission_path if self.state else None
        if path is not None and path != self._path:
            self._path = path
            self._geometry = _rig_and_ground(Path(path))
        return self._geometry

    def footprint_corners(self, navigation: Mapping[str, Any]) -> list[list[float]] | None:
        """Corners [latitude, longitude] of an exposure; None if they cannot be computed."""
        geometry = self._load()
        if geometry is None:
            return None
        rig, mount, ground_m = geometry
        try:
            corners = footprint_corners(rig, mount, navigation_from_json(navigation), ground_m)
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
    except (OSError, DaemonError, RigError):
        return None


def _receive(
    link: PageConnection,
    state: FlightState,
    gateway: CommandGateway,
    stopped: asyncio.Event,
    start_backfill: Callable[[str], None],
) -> None:
    """Receive all pending messages of the service."""
    try:
        while (message := link.receive(0.0)) is not None:
            if isinstance(message, ServiceEvent):
                state.apply(message.event)
                if message.event.get("event") == "mission":
                    start_backfill(str(message.event.get("path")))
            elif isinstance(message, Answer):
                gateway.on_answer(message)
            elif isinstance(message, Ping):
                link.send(Pong({}))
            elif isinstance(message, Stop):
                stopped.set()
                return
    except ServiceDisconnectedError:
        stopped.set()


def _absent_event(device: str, sentence: str) -> dict[str, Any]:
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
