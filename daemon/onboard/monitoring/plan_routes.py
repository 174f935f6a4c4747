"""Routes of the API for the plan: its lines, coverage gaps, and re-flights."""

from __future__ import annotations

import asyncio
import hashlib
import json
from typing import Annotated, Any, Literal

from fastapi import FastAPI, HTTPException, Path, Request, Response
from fastapi.params import Depends

from daemon.onboard.monitoring.coverage import Coverage, advice_json
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.limits import limits_json
from daemon.onboard.monitoring.remaining import remaining_json
from daemon.onboard.monitoring.server_messages import with_messages
from daemon.planning import reflight_files

ReflightFile = Literal["fly-again.geojson", "fly-again.kml", "fly-again.waypoints", "fly-again.csv"]
KINDS = {
    "fly-again.geojson": "application/geo+json",
    "fly-again.kml": "application/vnd.google-earth.kml+xml",
    "fly-again.waypoints": "text/plain",
    "fly-again.csv": "text/csv",
}
Number = Annotated[int, Path(ge=1, lt=10**9, description="of the exposure")]
NO_PLAN = "this mission is flown without a plan ([plan] file)"


def add_plan(app: FastAPI, state: FlightState, coverage: Coverage, watcher: Depends) -> None:
    """Add the routes; `watcher` authorizes readers."""

    @app.get("/api/v1/plan", dependencies=[watcher], tags=["plan"])
    async def plan() -> dict[str, Any]:
        """Planned lines and the specification; an empty object without a plan."""
        return coverage.plan_json() or {}

    @app.get("/api/v1/limits", dependencies=[watcher], tags=["plan"])
    async def limits() -> dict[str, Any]:
        """Limits of figures, `most` or `least`, by thresholds and plan."""
        specification = (coverage.plan_json() or {}).get("specification", {})
        return limits_json(state.mission_path, specification)

    @app.get("/api/v1/plan/stations/{number}", dependencies=[watcher], tags=["plan"])
    async def station(number: Number) -> dict[str, Any]:
        """The planned line of an exposure and its station on it, for a retake."""
        found = coverage.station_m(number)
        if found is None:
            raise HTTPException(404, f"exposure {number} has no place on a planned line")
        return {"number": number, "line": found[0], "at_m": round(found[1], 1)}

    @app.get("/api/v1/remaining", dependencies=[watcher], tags=["plan"])
    async def remaining() -> dict[str, Any]:
        """Lines, distance and light that are left."""
        return remaining_json(state, coverage)

    @app.get("/api/v1/triangulation", dependencies=[watcher], tags=["plan"])
    async def triangulation() -> dict[str, Any]:
        """The live triangulation: accuracy, drifts, findings, what to fly again; empty if off."""
        return dict(with_messages(state.triangulation()))

    @app.get(
        "/api/v1/advice",
        dependencies=[watcher],
        tags=["plan"],
        response_model=dict[str, Any],
        responses={304: {"description": "As the client has it (If-None-Match)"}},
    )
    async def advice(request: Request) -> Response:
        """Insufficient coverage of the plan: gaps, and segments still to be flown."""
        advice_task = coverage.advice_task()
        if advice_task is None:
            return tagged(request, {})
        found = advice_json(await asyncio.to_thread(advice_task), coverage)
        return tagged(request, with_messages(found))

    @app.get(
        "/api/v1/advice/{file}",
        dependencies=[watcher],
        tags=["plan"],
        response_class=Response,
        responses={200: {"content": {kind: {} for kind in KINDS.values()}}},
    )
    async def fly_again(file: ReflightFile) -> Response:
        """The segments as a plan (GeoJSON), for maps (KML), as a MAVLink mission, or a table."""
        advice_task = coverage.advice_task()
        if advice_task is None:
            raise HTTPException(404, NO_PLAN)
        found = await asyncio.to_thread(advice_task)
        texts = {
            "fly-again.geojson": lambda: reflight_files.geojson(
                found.segments, simulated=coverage.is_simulated
            ),
            "fly-again.kml": lambda: reflight_files.kml(
                found.segments, simulated=coverage.is_simulated
            ),
            "fly-again.waypoints": lambda: reflight_files.mavlink_mission(
                found.segments, height_m=coverage.height_m, distance_m=coverage.distance_m
            ),
            "fly-again.csv": lambda: reflight_files.table(
                found.segments, simulated=coverage.is_simulated
            ),
        }
        return Response(texts[file](), media_type=KINDS[file])


def tagged(request: Request, content: object) -> Response:
    """JSON under a tag of its content; no body where the client has that (RFC 9110, 13.1.2)."""
    body = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    tag = f'W/"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": tag}
    if tag in (one.strip() for one in request.headers.get("If-None-Match", "").split(",")):
        return Response(status_code=304, headers=headers)
    return Response(body, media_type="application/json", headers=headers)
