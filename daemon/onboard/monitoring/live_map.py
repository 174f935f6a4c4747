"""The orthomosaic of a flight for the page: which tiles have which version, and their pictures."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path as FilePath
from typing import Annotated, Any, Final

from fastapi import FastAPI, HTTPException, Path, Query, Response
from fastapi.params import Depends
from fastapi.responses import FileResponse

from daemon.onboard.live_orthomosaic.map_layout import FOLDER, STATE_FILE, tile_file
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.live_map_state import ABOUT
from daemon.onboard.monitoring.maps.tiles import TILE_MAX_BYTES, ZOOM_MAX
from daemon.onboard.monitoring.web.page_files import PRODUCT_POLICY

MAP: Final = FilePath("export") / FOLDER
REPORT: Final = FilePath("export") / "triangulation" / "live" / "report.html"
STATE_MAX_BYTES: Final = 4_000_000
TILES_AT_ONCE: Final = 4

Zoom = Annotated[int, Path(ge=0, le=ZOOM_MAX, description="level")]
Column = Annotated[int, Path(ge=0, lt=2**ZOOM_MAX, description="of the tile, from the west")]
Row = Annotated[int, Path(ge=0, lt=2**ZOOM_MAX, description="of the tile, from the north")]
After = Annotated[int, Query(ge=0, description="version; only newer tiles are listed")]


def add_live_map(app: FastAPI, state: FlightState, watcher: Depends) -> None:
    """Add the routes; `watcher` authorizes readers."""
    reading = asyncio.Semaphore(TILES_AT_ONCE)

    def folder() -> FilePath:
        if state.mission_path is None:
            raise HTTPException(404, "no mission yet")
        return FilePath(state.mission_path)

    @app.get("/api/v1/orthomosaic", dependencies=[watcher], tags=["maps"])
    async def orthomosaic(after: After = 0) -> dict[str, Any]:
        """The preliminary orthomosaic, and the tiles that are newer than a version.

        Of more than 1000 the newest are listed, and `is_cut` is true. Empty without one.
        """
        if state.mission_path is None:
            return {}
        found = state.live_map.changes(after)
        if not found:  # this process was started again, and no tile came since
            found = await asyncio.to_thread(_stored, folder() / MAP / STATE_FILE)
        return found

    @app.get(
        "/api/v1/orthomosaic/{zoom}/{x}/{y}",
        dependencies=[watcher],
        tags=["maps"],
        response_class=Response,
        responses={200: {"content": {"image/webp": {}}}, 204: {"description": "no tile"}},
    )
    async def tile(zoom: Zoom, x: Column, y: Row) -> Response:
        """A tile of the preliminary orthomosaic, web map grid, transparent without data."""
        path = tile_file(folder() / MAP, (zoom, x, y))
        async with reading:
            data = await asyncio.to_thread(_read, path)
        # Not stored by the browser: the next version and the next mission have the same address.
        headers = {"Cache-Control": "no-store"}
        if data is None:
            return Response(status_code=204, headers=headers)
        return Response(data, media_type="image/webp", headers=headers)

    @app.get(
        "/api/v1/triangulation/report",
        dependencies=[watcher],
        tags=["plan"],
        response_class=FileResponse,
        responses={200: {"content": {"text/html": {}}}},
    )
    async def report() -> FileResponse:
        """The quality report of the live triangulation, one page of HTML."""
        path = folder() / REPORT
        if not path.is_file():
            raise HTTPException(404, "the block was not adjusted yet")
        policy = {"Content-Security-Policy": PRODUCT_POLICY}
        return FileResponse(path, media_type="text/html", headers=policy)


def _read(path: FilePath) -> bytes | None:
    try:
        with path.open("rb") as file:
            data = file.read(TILE_MAX_BYTES + 1)
    except OSError:
        return None
    return data if len(data) <= TILE_MAX_BYTES else None


def _stored(path: FilePath) -> dict[str, Any]:
    """What an earlier process wrote; all its tiles may have changed."""
    try:
        if path.stat().st_size > STATE_MAX_BYTES:
            return {}
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(found, dict):
        return {}
    about = {key: found[key] for key in ABOUT if key in found}
    absent = about.get("not_placed")
    about["not_placed"] = len(absent) if isinstance(absent, list) else 0
    return {**about, "tiles": [], "is_cut": True} if about.get("version") else {}
