"""The live orthomosaic of one mission: follows its live triangulation, and writes its files.

It writes only below `export/live-orthomosaic`. A failure stops the map, never the triangulation: it
begins again at the end of the line, and takes in what it missed a few images at a time.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.store import durable
from daemon.mission.store.level0 import read_tiff
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
from processing.pipelines.live_triangulation import LiveOrientation

FORMAT: Final = 1
TILES_PER_EVENT: Final = 200
POINTS_MAX: Final = 2000
CATCH_UP: Final = 2
"""Images that are placed with each exposure after the map began again."""
LANDING_S: Final = 4.0
"""For images that are missing at landing."""
BEHIND: Final = "the map began again too late for it"

Emit = Callable[[dict[str, Any]], None]


class MissionMap:
    """The map of a mission while its exposures are triangulated.

    Args:
        done: the triangulation; its `on_image` is set.
        emit: receives an event for published tiles.
        wanted_gsd_m: of the map; None: several times that of the images.
        on_failure: receives a sentence if the map stops.
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
        self._version = 0
        done.on_image = self._add

    def block_adjusted(self) -> None:
        """Level the images, follow their orientations, and publish what changed."""
        self.has_failed = False
        self._guarded(self._level)

    def use_mission(self) -> None:
        """Go on in the mission's folder, which is on another disk now.

        If the earlier disk cannot be read, the map begins again without its images.
        """
        folder = self._done.mission.export_dir / FOLDER
        if folder == self.folder:
            return
        self.folder, self.has_failed = folder, False
        if self.live is not None:
            self._guarded(self._move)
            self.has_failed = False

    def deliver(self) -> bool:
        """Write the files of the landing.

        Returns:
            Whether they are complete; also true without any image.
        """
        self.has_failed = False
        return self._guarded(self._deliver)

    def _guarded(self, step: Callable[[], None]) -> bool:
        if self.has_failed:
            return False
        try:
            step()
        except Exception as error:  # noqa: BLE001 - libraries raise errors of their own
            self.has_failed = True
            if self.live is not None:
                self._version, self.live = self.live.files.version, None
            self._on_failure(
                f"The live orthomosaic stopped: {str(error) or type(error).__name__}. Capture and "
                "triangulation go on. It begins again at the end of the line. After landing, run "
                "`syntopic orthomosaic MISSION`."
            )
            return False
        return True

    def _move(self) -> None:
        assert self.live is not None
        self.live.files.move_to(self.folder)
        self._write_state(is_complete=False, files={})

    def _add(self, one: LiveOrientation, pixels: NDArray[np.uint16]) -> None:
        self._guarded(lambda: self._place(one, pixels))

    def _place(self, one: LiveOrientation, pixels: NDArray[np.uint16]) -> None:
        begun = time.perf_counter()
        live = self._begun()
        if live is None or self._done.live is None:
            return
        self._catch_up(live, one.image.number)
        published = live.add(one, pixels, self._done.live.orientations)
        self.seconds = time.perf_counter() - begun
        self._announce(published, one.image.number)

    def _begun(self) -> LiveOrthomosaic | None:
        """The map, begun if it is not; None without an orientation."""
        done = self._done
        if self.live is None and done.frame is not None and done.live is not None:
            files = TileFiles(self.folder, max(self._version, self._last_version()))
            self.live = LiveOrthomosaic(
                files, done.live.image, done.frame, self._ground(), self._wanted_gsd_m
            )
        return self.live

    def _catch_up(self, live: LiveOrthomosaic, newest: int, until_s: float = math.inf) -> None:
        """Place exposures that came while there was no map, the oldest first.

        Args:
            newest: exposure that is placed elsewhere; 0: none.
            until_s: monotonic; those left then are named. Without a limit, at most `CATCH_UP`.
        """
        assert self._done.live is not None
        placed = 0
        for one in list(self._done.live.orientations):
            number = one.image.number
            if number == newest or live.knows(number):
                continue
            if time.monotonic() > until_s:
                live.not_placed[number] = BEHIND
                continue
            if math.isinf(until_s) and placed >= CATCH_UP:
                break
            try:
                pixels = read_tiff(
                    self._done.mission.level2(number) / "pan.tif",
                    width_px=live.image.width_px,
                    height_px=live.image.height_px,
                )
            except (OSError, ValueError) as error:
                live.not_placed[number] = f"its image cannot be read again ({error})"
                continue
            live.place(one, pixels)
            placed += 1

    def _level(self) -> None:
        if self.live is None or self._done.live is None:
            return
        self.live.level(self._done.live.orientations, self._ground())
        self._announce(self.live.publish_levelled(), None)

    def _announce(self, published: Sequence[PublishedTile], number: int | None) -> None:
        assert self.live is not None
        about = self.live.as_json()
        # Before the page receives a version: a process that is started again counts on from it.
        self._write_state(is_complete=False, files={})
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

    def _deliver(self) -> None:
        live = self._begun()
        if live is None:
            return
        self._catch_up(live, 0, time.monotonic() + LANDING_S)
        if not live.tiles:
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
        check = done.heights
        is_wrong = check is not None and (check.is_contradicted or bool(check.problem))
        if done.relief is not None and not is_wrong:
            return ModelGround(done.relief, None if check is None else check.uncovered)
        if done.live is not None and done.frame is not None:
            _, xyz, _ = done.live.tied_points()
            found = done.frame.to_geodetic(xyz[:: max(len(xyz) // POINTS_MAX, 1)])
            # Longitudes without a jump, for their median and the tilt of the plane.
            found[:, 1] += 360.0 * np.round((done.frame.longitude_deg - found[:, 1]) / 360.0)
            if len(found):
                height = float(np.median(found[:, 2]))
                per = metres_per_degree(float(found[0, 0]), height)
                plane = plane_through(found, per)
                if plane is not None:
                    return plane
        frame = done.frame
        assert frame is not None
        return PlaneGround(frame.latitude_deg, frame.longitude_deg, done.plan.ground_height_m)
