"""Routes of base maps: what there is, and their tiles."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Path, Response
from fastapi.params import Depends

from daemon.onboard.monitoring.maps.map_library import MapLibrary
from daemon.onboard.monitoring.maps.tiles import MVT, ZOOM_MAX, BaseMapError

TILES_AT_ONCE = 2
TILE_CACHE = "private, max-age=600"
KINDS = ("image/png", "image/jpeg", "image/webp", "image/gif", MVT)

MapNumber = Annotated[int, Path(ge=0, lt=100, description="of the map, from /api/v1/maps")]
Zoom = Annotated[int, Path(ge=0, le=ZOOM_MAX, description="level")]
Column = Annotated[int, Path(ge=0, lt=2**ZOOM_MAX, description="of the tile, from the west")]
Row = Annotated[int, Path(ge=0, lt=2**ZOOM_MAX, description="of the tile, from the north")]


def add_maps(app: FastAPI, library: MapLibrary, watcher: Depends) -> None:
    """Add the routes; `watcher` authorizes readers."""
    reading = asyncio.Semaphore(TILES_AT_ONCE)

    @app.get("/api/v1/maps", dependencies=[watcher], tags=["maps"])
    async def maps() -> list[dict[str, Any]]:
        """Base maps that are configured, with zoom levels and bounds."""
        async with reading:
            return await asyncio.to_thread(library.descriptions)

    @app.get(
        "/api/v1/maps/{number}/{zoom}/{x}/{y}",
        dependencies=[watcher],
        tags=["maps"],
        response_class=Response,
        responses={200: {"content": {kind: {} for kind in KINDS}}, 204: {"description": "no tile"}},
    )
    async def tile(number: MapNumber, zoom: Zoom, x: Column, y: Row) -> Response:
        """A tile of the web map grid; 204 where the map has none."""
        async with reading:
            try:
                found = await asyncio.to_thread(library.tile, number, zoom, x, y)
            except BaseMapError as error:
                raise HTTPException(404, str(error)) from error
        if found is None:
            return Response(status_code=204, headers={"Cache-Control": TILE_CACHE})
        headers = {"Cache-Control": TILE_CACHE}
        if found.encoding:
            headers["Content-Encoding"] = found.encoding
        return Response(found.data, media_type=found.media_type, headers=headers)
