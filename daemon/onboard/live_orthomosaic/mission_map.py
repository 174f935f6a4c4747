"""The live orthomosaic of one mission: follows its live triangulation, and writes its files.

It writes only below `export/live-orthomosaic`. A failure ends the map, never the triangulation.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon import DaemonError
from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.store import durable
from daemon.onboard.live_orthomosaic.delivery import (
    COG_FILE,
    PMTILES_FILE,
    bounds_of,
    write_cog,
    write_map,
)
from daemon.onboard.live_orthomosaic.live_orthomosaic import LiveOrthomosaic, PublishedTile
from daemon.onboard.live_orthomosaic.map_ground import (
    MapGround,
    ModelGround,
    PlaneGround,
    plane_through,
)
from daemon.onboard.live_orthomosaic.map_layout import FOLDER, STATE_FILE
from daemon.onboard.live_orthomosaic.tile_files import TileFiles
from daemon.onboard.triangulation.mission_triangulation import MissionTriangulation
from daemon.orientation.geodesy import metres_per_degree
from drivers import DriverError
from processing import ProcessingError
from processing.pipelines.live_triangulation import LiveOrientation

FORMAT: Final = 1
TILES_PER_EVENT: Final = 200
POINTS_MAX: Final = 2000

Emit = Callable[[dict[str, Any]], None]


class MissionMap:
    """The map of a mission while its exposures are triangulated.

    Args:
        done: the triangulation; its `on_image` is set.
        emit: receives an event for published tiles.
        wanted_gsd_m: of the map; None: several times that of the images.
        on_failure: receives a sentence if the map ends.
    """

    def __init__(
        self,
        done: MissionTriangulation,
        emit: Emit,
        wanted_gsd_m: float | None = None,
        on_failure: Callable[[str], None] = lambda _sentence: None,
    ) -> None:
        self._done, self._emit, self._on_failure = done, emit, on_failure
        self._wanted_gsd_m = wanted_gsd_m
        self.folder = done.mission.export_dir / FOLDER
        self.live: LiveOrthomosaic | None = None
        self.has_failed = False
        self.seconds = 0.0
        self._count = 0
        done.on_image = self._add

    def block_adjusted(self) -> None:
        """Level the images, follow their orientations, and publish what changed."""
        self._guarded(self._level)

    def deliver(self) -> bool:
        """Write the files of the landing.

        Returns:
            Whether they are complete; also true without any image.
        """
        return self._guarded(self._deliver)

    def _guarded(self, step: Callable[[], None]) -> bool:
        if self.has_failed:
            return False
        try:
            step()
        except (
            OSError,
            DaemonError,
            DriverError,
            ProcessingError,
            ValueError,
            MemoryError,
        ) as error:
            self.has_failed = True
            self._on_failure(
                f"The live orthomosaic ended: {str(error) or type(error).__name__}. Capture and "
                "triangulation go on. Run `syntopic orthomosaic MISSION` after landing."
            )
            return False
        return True

    def _add(self, one: LiveOrientation, pixels: NDArray[np.uint16]) -> None:
        self._guarded(lambda: self._place(one, pixels))

    def _place(self, one: LiveOrientation, pixels: NDArray[np.uint16]) -> None:
        begun = time.perf_counter()
        live = self.live
        if live is None:
            if self._done.frame is None or self._done.live is None:
                return
            live = self.live = LiveOrthomosaic(
                TileFiles(self.folder, self._last_version()), self._done.live.image,
                self._done.frame, self._ground(), self._wanted_gsd_m,
            )  # fmt: skip
        orientations = self._done.live.orientations if self._done.live is not None else ()
        published = live.add(one, pixels, orientations)
        self.seconds = time.perf_counter() - begun
        self._announce(published, one.image.number)

    def _level(self) -> None:
        if self.live is None or self._done.live is None:
            return
        self.live.level(self._done.live.orientations, self._ground())
        self._announce(self.live.publish_levelled(), None)

    def _announce(self, published: Sequence[PublishedTile], number: int | None) -> None:
        assert self.live is not None
        about = self.live.as_json()
        parts = [published[k : k + TILES_PER_EVENT] for k in range(0, len(published),
                                                                  TILES_PER_EVENT)]  # fmt: skip
        for part in parts or [()]:
            tiles = [[*one.tile, one.version, one.size] for one in part]
            self._emit(
                {
                    "event": "orthomosaic",
                    **({} if number is None else {"number": number}),
                    "tiles": tiles,
                    "pending": self.live.pending,
                    "seconds": round(self.seconds, 3),
                    **about,
                }
            )
        self._write_state(is_complete=False, files={})

    def _deliver(self) -> None:
        live = self.live
        if live is None or not live.tiles:
            return
        self._level()
        files: dict[str, int] = {}
        tags = {"SYNTOPIC_PRELIMINARY": "YES"}
        if self._done.is_simulated:
            tags["SYNTOPIC_SIMULATED"] = "YES"
        metadata = {
            "name": f"{self._done.mission.id}, preliminary",
            "attribution": "Simulated" if self._done.is_simulated else "",
            "is_preliminary": True,
        }
        files[COG_FILE] = write_cog(live, self.folder / COG_FILE, tags)
        files[PMTILES_FILE] = write_map(live, self.folder / PMTILES_FILE, metadata)
        self._write_state(is_complete=True, files=files)
        live.files.drop_work()

    def _write_state(self, *, is_complete: bool, files: dict[str, int]) -> None:
        live = self.live
        assert live is not None
        content = {
            "format": FORMAT,
            "mission": self._done.mission.id,
            "is_preliminary": True,
            "is_complete": is_complete,
            "simulated": self._done.is_simulated,
            **live.as_json(),
            "bounds": list(bounds_of(live.tiles)) if live.tiles else None,
            "not_placed": [
                {"exposure": number, "reason": reason}
                for number, reason in sorted({**self._done.skipped, **live.not_placed}.items())
            ],
            "files": files,
        }
        durable.replace_file(self.folder / STATE_FILE, canonical_bytes(content))

    def _last_version(self) -> int:
        """Version of the last picture that an earlier process published, so that later ones have
        higher numbers."""
        try:
            found = json.loads((self.folder / STATE_FILE).read_text(encoding="utf-8"))["version"]
            return max(int(found), 0)
        except (OSError, ValueError, KeyError, TypeError):
            return 0

    def _ground(self) -> MapGround:
        """The height model if it fits the tie points, else the plane through these, else the
        plan's height."""
        done = self._done
        is_wrong = any(one.name.startswith("HEIGHT_MODEL") for one in done.findings)
        if done.relief is not None and not is_wrong:
            return ModelGround(done.relief)
        if done.live is not None and done.frame is not None:
            _, xyz, _ = done.live.tied_points()
            found = done.frame.to_geodetic(xyz[:: max(len(xyz) // POINTS_MAX, 1)])
            if len(found):
                height = float(np.median(found[:, 2]))
                per = metres_per_degree(float(found[0, 0]), height)
                plane = plane_through(found, per)
                if plane is not None:
                    return plane
        frame = done.frame
        assert frame is not None
        return PlaneGround(frame.latitude_deg, frame.longitude_deg, done.plan.ground_height_m)
