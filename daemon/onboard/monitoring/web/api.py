"""The API over HTTP and WebSocket: state for readers, commands for token holders.

Errors are problem+json (RFC 9457). Products are read from the mission folder; the
service receives only commands.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import Depends, FastAPI, HTTPException, Query, Request, Response, WebSocket
from fastapi import Path as PathParameter
from fastapi.exceptions import RequestValidationError
from fastapi.middleware.gzip import GZipMiddleware
from fastapi.responses import FileResponse, PlainTextResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.requests import HTTPConnection
from starlette.websockets import WebSocketDisconnect

from daemon.mission.layout import exposure_name
from daemon.onboard.monitoring.access.command_gateway import (
    AnswerTimeoutError,
    CommandGateway,
    NotPermittedError,
)
from daemon.onboard.monitoring.access.roles import COMMAND_ROLES, Principal, missing_role
from daemon.onboard.monitoring.access.tokens import FailedAttempts, TokenHolder, Tokens
from daemon.onboard.monitoring.coverage import Coverage
from daemon.onboard.monitoring.flight_state import EXPOSURES_MAX, PARTS, PREVIEW_PARTS, FlightState
from daemon.onboard.monitoring.guidance_routes import add_guidance
from daemon.onboard.monitoring.image_routes import add_images
from daemon.onboard.monitoring.live_map import add_live_map
from daemon.onboard.monitoring.map_routes import add_maps
from daemon.onboard.monitoring.maps.map_library import MapLibrary
from daemon.onboard.monitoring.metrics import exposition
from daemon.onboard.monitoring.plan_routes import add_plan
from daemon.onboard.monitoring.server_messages import message_of, with_messages
from daemon.onboard.monitoring.telemetry import MIN_BYTES_PER_S, Subscription, packed
from daemon.onboard.monitoring.web.connections import (
    Connections,
    source_of,
)
from daemon.onboard.monitoring.web.page_files import (
    PAGE,
    PRODUCT_POLICY,
    PageFiles,
    add_security_headers,
)
from daemon.onboard.monitoring.web.problems import (
    documented_problem,
    http_problem,
    validation_problem,
)
from daemon.onboard.monitoring.web.request_body import COMMAND_OPENAPI, command_body
from daemon.onboard.monitoring.web.request_filter import bearer_token
from daemon.onboard.monitoring.web.watch_admission import admit_watcher, connection_of

TELEMETRY_TICK_S = 0.05
SEND_TIMEOUT_S = 5.0
"""A client that does not accept a record in this time is disconnected."""

COMPRESSED_MIN_BYTES = 1000
COMPRESSION_LEVEL = 5
"""Of answers in JSON: 0.5 MB of footprints become 0.1 MB in 10 ms. Pictures stay as they are."""

LEAST_COMMAND = "arm"
"""A command with the lowest required role."""

"""Subprotocol that a browser offers for telemetry, in addition to its token."""

IMAGES = {
    "quicklook.jpg": "image/jpeg",
    "thumbnail.jpg": "image/jpeg",
    "residuals.svg": "image/svg+xml",
    "residuals.json": "application/json",
    "histogram.json": "application/json",
    "quality.json": "application/json",
}


class CommandResponse(BaseModel):
    """Result of a command."""

    done: bool
    sentence: str
    message: dict[str, Any] | None = None
    """Code and parameters of the sentence."""


Number = Annotated[int, PathParameter(ge=1, lt=10**9, description="of the exposure")]
Product = Literal[
    "quicklook.jpg",
    "thumbnail.jpg",
    "residuals.svg",
    "residuals.json",
    "histogram.json",
    "quality.json",
]
Part = Literal[
    "exposures",
    "devices",
    "settings",
    "track",
    "history",
    "events",
    "residuals",
    "thumbnails",
]
CommandName = Literal[
    "arm",
    "start",
    "stop",
    "trigger",
    "interval",
    "distance",
    "land",
    "reject",
    "accept",
    "withdraw",
    "retake",
    "acknowledge",
    "new-mission",
    "verify",
    "copy",
    "report",
    "shutdown",
    "exposure",
    "release-disk",
    "accept-disk",
]


@dataclass(frozen=True)
class AccessSettings:
    """Access of readers and of senders of commands.

    `anonymous_read`: reading requires no token.
    """

    tokens: Tokens
    anonymous_read: bool = True


def create_app(
    state: FlightState,
    gateway: CommandGateway,
    settings: AccessSettings,
    coverage: Coverage | None = None,
    connections: Connections | None = None,
    maps: MapLibrary | None = None,
) -> FastAPI:
    """The application; its only own state is the open connections."""
    app = FastAPI(
        title="Syntopic",
        description="State, products and commands of an aerial camera in flight.",
        version="1",
        responses={"default": documented_problem(), 422: documented_problem()},
        docs_url=None,
        redoc_url=None,
    )
    # Inside of the next one, which sends every answer in parts.
    app.add_middleware(
        GZipMiddleware, minimum_size=COMPRESSED_MIN_BYTES, compresslevel=COMPRESSION_LEVEL
    )
    app.middleware("http")(add_security_headers)
    app.add_exception_handler(StarletteHTTPException, http_problem)
    app.add_exception_handler(RequestValidationError, validation_problem)
    access = _AccessControl(settings, gateway, connections or Connections())
    _add_state(app, state, access)
    _add_products(app, state, access)
    _add_commands(app, state, gateway, access)
    _add_telemetry(app, state, access)
    add_guidance(app, state, access, PAGE / "pilot.html")
    add_maps(app, maps or MapLibrary(()), Depends(access.watch))
    add_live_map(app, state, Depends(access.watch))
    add_images(app, state, Depends(access.watch))
    add_plan(app, state, coverage or Coverage(state), Depends(access.watch))
    _add_page(app)
    return app


class _AccessControl:
    """Checks tokens, as dependencies of routes."""

    def __init__(
        self, settings: AccessSettings, gateway: CommandGateway, connections: Connections
    ) -> None:
        self._settings = settings
        self._gateway = gateway
        self._attempts = FailedAttempts()
        self.connections = connections

    async def watch(self, request: Request) -> None:
        if not self._settings.anonymous_read:
            self.admit(request)

    async def command(self, request: Request) -> Principal:
        """The authorized sender of a command; checked before its name and body."""
        address, name = _address(request), request.path_params.get("name", "")
        try:
            holder = self.admit(request)
        except HTTPException as error:
            unauthenticated = Principal("unknown", None, address)
            self._gateway.refuse(name, unauthenticated, error.detail)
            raise
        by = Principal(holder.name, holder.role, address)
        if name in COMMAND_ROLES:
            try:
                self._gateway.admit(name, by)
            except NotPermittedError as error:
                raise HTTPException(403, str(error)) from error
            return by
        self._gateway.refuse(name, by, "there is no such command")
        if missing_role(by, LEAST_COMMAND) is not None:
            raise HTTPException(403, f"{by.name} has the role {by.role}, which gives no commands")
        return by  # an authorized sender may learn the names of commands

    def admit(self, http: HTTPConnection) -> TokenHolder:
        """The holder of this token. A valid one is admitted after any number of wrong ones.

        Raises:
            HTTPException: 401, or 429 after too many wrong tokens.
        """
        token = bearer_token(http.scope["headers"])
        if token is None:
            raise HTTPException(
                401,
                "a token is needed (syntopic token add NAME --role operator makes one)",
                {"WWW-Authenticate": "Bearer"},
            )
        holder = self._settings.tokens.holder_of(token)
        if holder is None:
            source, now_s = source_of(_address(http)), time.monotonic()
            if self._attempts.is_blocked(source, now_s):
                raise HTTPException(429, "too many wrong tokens from this address; wait a minute")
            self._attempts.failed(source, now_s)
            raise HTTPException(401, "token rejected", {"WWW-Authenticate": "Bearer"})
        connection = connection_of(http)
        if connection is not None:
            connection.is_authenticated = True
        return holder

    def may_watch(self, http: HTTPConnection) -> bool:
        if self._settings.anonymous_read and bearer_token(http.scope["headers"]) is None:
            return True
        try:
            self.admit(http)
        except HTTPException:
            return self._settings.anonymous_read
        return True


def _add_state(app: FastAPI, state: FlightState, access: _AccessControl) -> None:
    watcher = Depends(access.watch)

    @app.get("/api/v1/state", dependencies=[watcher], tags=["state"])
    async def whole_state() -> dict[str, Any]:
        """The complete state."""
        return _mapping(state.snapshot())

    @app.get("/api/v1/brief", dependencies=[watcher], tags=["state"])
    async def brief_state() -> dict[str, Any]:
        """Phase, ledger, disk, clock, faults."""
        return _mapping({"version": 1, **state.brief()})

    @app.get("/api/v1/ledger", dependencies=[watcher], tags=["state"])
    async def ledger() -> dict[str, Any]:
        """The balance sheet of triggers, frames and marks."""
        return dict(state.brief()["status"].get("ledger") or {})

    @app.get("/api/v1/devices", dependencies=[watcher], tags=["state"])
    async def devices() -> list[dict[str, Any]]:
        """Every device, whether it delivers, what helps if not, and its counters."""
        return _listed(state.devices())

    @app.get("/api/v1/faults", dependencies=[watcher], tags=["state"])
    async def faults() -> list[dict[str, Any]]:
        """Active faults, and cleared ones that are not acknowledged."""
        return _listed(state.faults())

    @app.get("/api/v1/events", dependencies=[watcher], tags=["state"])
    async def events(after: Annotated[int, Query(ge=0, lt=2**53)] = 0) -> list[dict[str, Any]]:
        """What happened, oldest first, after a sequence number."""
        return _listed(state.changed("events", after))

    @app.get(
        "/api/v1/configuration",
        dependencies=[watcher],
        tags=["state"],
        response_class=PlainTextResponse,
        responses={200: {"content": {"text/plain": {}}}},
    )
    async def configuration() -> PlainTextResponse:
        """The configuration that is flown, TOML."""
        if state.mission_path is None:
            raise HTTPException(404, "no mission yet")
        path = Path(state.mission_path) / "service.toml"
        try:
            return PlainTextResponse(path.read_text("utf-8"))
        except OSError as error:
            raise HTTPException(404, "the mission has no service.toml") from error

    @app.get(
        "/api/v1/report",
        dependencies=[watcher],
        tags=["state"],
        response_class=FileResponse,
        responses={200: {"content": {"text/html": {}}}},
    )
    async def mission_report() -> FileResponse:
        """The mission report, as written by the command report."""
        if state.mission_path is None:
            raise HTTPException(404, "no mission yet")
        path = Path(state.mission_path) / "export" / "report.html"
        if not path.is_file():
            raise HTTPException(404, "the mission has no report (yet)")
        policy = {"Content-Security-Policy": PRODUCT_POLICY}
        return FileResponse(path, media_type="text/html", headers=policy)

    @app.get("/metrics", tags=["state"], dependencies=[watcher], response_class=PlainTextResponse)
    async def metrics() -> Response:
        """Prometheus exposition."""
        return Response(exposition(state), media_type="text/plain; version=0.0.4")


def _add_products(app: FastAPI, state: FlightState, access: _AccessControl) -> None:
    watcher = Depends(access.watch)

    @app.get("/api/v1/exposures", dependencies=[watcher], tags=["exposures"])
    async def exposures(
        after: Annotated[int, Query(ge=0, lt=10**9, description="number")] = 0,
        limit: Annotated[int, Query(ge=1, le=EXPOSURES_MAX)] = 100,
    ) -> list[dict[str, Any]]:
        """Exposures by number."""
        return _listed(state.exposures(after, limit))

    @app.get("/api/v1/footprints", dependencies=[watcher], tags=["exposures"])
    async def footprints(
        newest: Annotated[int, Query(ge=1, le=EXPOSURES_MAX)] = EXPOSURES_MAX,
    ) -> list[dict[str, Any]]:
        """Number, verdict and footprint of all exposures but so many of the newest."""
        return state.older_footprints(newest)

    @app.get("/api/v1/exposures/{number}", dependencies=[watcher], tags=["exposures"])
    async def exposure(number: Number) -> dict[str, Any]:
        """One exposure: frames, time, verdict."""
        found = state.exposure(number)
        if found is None:
            raise HTTPException(404, f"exposure {number} is not known")
        return _mapping(found)

    @app.get(
        "/api/v1/exposures/{number}/{product}",
        dependencies=[watcher],
        tags=["exposures"],
        response_class=FileResponse,
        responses={200: {"content": {kind: {} for kind in IMAGES.values()}}},
    )
    async def product(number: Number, product: Product) -> FileResponse:
        """Quick look, residual vectors, histogram or quality report, as stored."""
        if state.mission_path is None:
            raise HTTPException(404, "no mission yet")
        path = Path(state.mission_path) / "L2" / exposure_name(number) / product
        if not path.is_file():
            raise HTTPException(404, f"exposure {number} has no {product} (yet)")
        policy = {"Content-Security-Policy": PRODUCT_POLICY}
        return FileResponse(path, media_type=IMAGES[product], headers=policy)


def _add_commands(
    app: FastAPI, state: FlightState, gateway: CommandGateway, access: _AccessControl
) -> None:
    principal = Depends(access.command)

    @app.post(
        "/api/v1/commands/{name}",
        tags=["commands"],
        openapi_extra=COMMAND_OPENAPI,
        response_model_exclude_none=True,
    )
    async def command(
        name: CommandName, request: Request, by: Principal = principal
    ) -> CommandResponse:
        """arm, start or stop the line, trigger, land, acknowledge, expose otherwise.

        After landing: verify, copy, report and shutdown.

        Needs a token of the role operator; new-mission, release-disk, accept-disk and shutdown
        need the role administrator. Every command is answered by the service and recorded in the
        audit log.
        """
        try:
            given = await command_body(request)
            if name == "acknowledge":
                if given.fault is None:
                    raise HTTPException(409, "acknowledge needs the fault's id")
                if not any(fault["id"] == given.fault for fault in state.faults()):
                    raise HTTPException(404, f"no fault {given.fault!r} is listed")
        except HTTPException as error:
            gateway.refuse(name, by, error.detail)
            raise
        try:
            answer = await gateway.command(name, given.model_dump(exclude_none=True), by)
        except NotPermittedError as error:
            raise HTTPException(403, str(error)) from error
        except AnswerTimeoutError as error:
            raise HTTPException(504, str(error)) from error
        if answer.done and name == "acknowledge" and given.fault is not None:
            state.acknowledge(given.fault, f"{by.name} ({by.role})")
        if not answer.done:
            raise HTTPException(409, answer.sentence)
        message = message_of(answer.sentence)
        return CommandResponse(done=True, sentence=answer.sentence, message=message)


def _add_telemetry(app: FastAPI, state: FlightState, access: _AccessControl) -> None:
    @app.websocket("/api/v1/telemetry")
    async def telemetry(
        socket: WebSocket,
        form: Literal["json", "msgpack"] = "msgpack",
        bytes_per_s: float = math.inf,
        newest: Annotated[int | None, Query(ge=1, le=EXPOSURES_MAX)] = None,
        without: Annotated[list[Part] | None, Query()] = None,
    ) -> None:
        """Records as in docs/reference/flight/telemetry.md, until the client disconnects.

        The first record holds the complete state, unless `newest` limits it.
        """
        if not await admit_watcher(socket, access):
            return
        # JSON clients fetch pictures over HTTP.
        offered = PARTS if form == "json" else (*PARTS, *PREVIEW_PARTS)
        parts = tuple(one for one in offered if one not in (without or ()))
        subscription = Subscription(max(bytes_per_s, MIN_BYTES_PER_S), parts, newest)
        disconnected = asyncio.ensure_future(_wait_for_disconnect(socket))
        try:
            while not disconnected.done():
                record = subscription.record(state, time.monotonic())
                if record is not None:
                    await asyncio.wait_for(_send(socket, record, form), SEND_TIMEOUT_S)
                await asyncio.wait([disconnected], timeout=TELEMETRY_TICK_S)
        except (TimeoutError, WebSocketDisconnect, RuntimeError):
            pass  # it stalled or disconnected
        finally:
            disconnected.cancel()
            with suppress(RuntimeError, WebSocketDisconnect):
                await socket.close()


async def _send(socket: WebSocket, record: Any, form: str) -> None:
    if form == "msgpack":
        await socket.send_bytes(packed(record))
    else:
        await socket.send_json(with_messages(record))


async def _wait_for_disconnect(socket: WebSocket) -> None:
    """Discard messages of the client until it disconnects."""
    with suppress(WebSocketDisconnect, RuntimeError):
        while True:
            await socket.receive_text()


def _add_page(app: FastAPI) -> None:
    @app.get("/docs", include_in_schema=False)
    async def docs() -> FileResponse:
        return FileResponse(PAGE / "api.html")

    app.mount("/", PageFiles(PAGE), name="page")


def _mapping(value: Mapping[str, Any]) -> dict[str, Any]:
    return dict(with_messages(value))


def _listed(values: Sequence[Any]) -> list[dict[str, Any]]:
    return list(with_messages(values))


def _address(http: HTTPConnection) -> str:
    return http.client.host if http.client else ""
