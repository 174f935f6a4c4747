"""Routes of images at full resolution: layers of an exposure, and their tiles on request."""

from __future__ import annotations

import asyncio
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from fastapi import FastAPI, HTTPException, Path, Query, Response
from fastapi.params import Depends

from daemon.mission.layout import exposure_name
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.image_tiles import ImageTileError, ImageTiles

TILES_AT_ONCE = 2

Number = Annotated[int, Path(ge=1, lt=10**9, description="of the exposure")]
Layer = Annotated[str, Path(pattern=r"^[A-Za-z0-9_-]{1,40}$", description="from /images/NUMBER")]
Source = Annotated[
    str | None, Query(pattern=r"^[A-Za-z0-9_-]{1,40}$", description="layer; default: the first")
]
Index = Annotated[int, Path(ge=0, lt=1000)]
Reduction = Literal["1", "2", "4", "8", "16"]


def add_images(app: FastAPI, state: FlightState, watcher: Depends) -> None:
    """Add the routes; `watcher` authorizes readers."""
    reading = asyncio.Semaphore(TILES_AT_ONCE)
    tiles = ImageTiles()

    def folder_of(number: int) -> FilePath:
        if state.mission_path is None:
            raise HTTPException(404, "no mission yet")
        return FilePath(state.mission_path) / "L2" / exposure_name(number)

    @app.get("/api/v1/images/{number}", dependencies=[watcher], tags=["images"])
    async def image(number: Number) -> dict[str, Any]:
        """Layers of an exposure with their size in pixels."""
        folder = folder_of(number)
        async with reading:
            try:
                return {"number": number, **await asyncio.to_thread(tiles.about, folder)}
            except ImageTileError as error:
                raise HTTPException(404, f"exposure {number}: {error}") from error

    @app.get(
        "/api/v1/images/{number}/{layer}/{reduction}/{x}/{y}",
        dependencies=[watcher],
        tags=["images"],
        response_class=Response,
        responses={200: {"content": {"image/jpeg": {}, "image/png": {}}}},
    )
    async def tile(
        number: Number,
        layer: Layer,
        reduction: Reduction,
        x: Index,
        y: Index,
        of: Source = None,
    ) -> Response:
        """A tile of 256 pixels; `reduction` pixels along a side become one.

        A derived layer (saturation, sharpness) is that of the layer `of`.
        """
        folder = folder_of(number)
        async with reading:
            try:
                found = await asyncio.to_thread(tiles.tile, folder, layer, int(reduction), x, y, of)
            except ImageTileError as error:
                raise HTTPException(404, f"exposure {number}: {error}") from error
        if found is None:
            return Response(status_code=204)
        # Not cached: the next mission has an exposure of the same number.
        return Response(found.data, media_type=found.media_type)
