"""Building a catalog: every place is read, and what cannot be read is stated."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from daemon import DaemonError
from daemon.mission.store.output_places import refuse_foreign_files
from daemon.mission.transfer.object_store import is_store_url
from daemon.postflight.mission_catalog.catalog_files import read_sources, write_catalog
from daemon.postflight.mission_catalog.exposure_rows import MissionRows, mission_rows
from daemon.postflight.mission_catalog.mission_sources import SourceError, missions_at
from drivers.base.extras import require
from processing.rig import RigError

_FILES = re.compile(
    r"catalog\.json|exposures\.(parquet|gpkg)(-wal|-shm|-journal|\.aux\.xml)?|[^/]+/[^/]+\.json"
)
"""What is written, and what programs that read it put next to it."""


@dataclass(frozen=True)
class CatalogBuild:
    """Counts of a built catalog, and a sentence for each mission or exposure left out."""

    missions: int
    exposures: int
    failures: tuple[str, ...]


def build_catalog(
    folder: Path, places: Sequence[str], *, replaces_places: bool = False
) -> CatalogBuild:
    """Read the places of a catalog and further ones, and write it.

    Args:
        folder: of the catalog; replaced as a whole. It must be empty, new, or a catalog.
        places: missions, folders of missions, stores, added to those of the catalog.
        replaces_places: they take the place of those of the catalog.

    Raises:
        SourceError: no place, the folder is no catalog, or no mission could be read.
        OutputPlaceError: the folder is a catalog, and holds something else as well.
        OSError: the disk refused; the earlier catalog is kept.
    """
    known = read_sources(folder)
    if folder.exists() and not known and (not folder.is_dir() or any(folder.iterdir())):
        raise SourceError(f"{folder}: is not empty and no catalog; choose another folder")
    refuse_foreign_files(folder, _FILES, cure="choose another folder")
    given = [p.rstrip("/") if is_store_url(p) else str(Path(p).resolve()) for p in places]
    if replaces_places and not given:
        raise SourceError("--replace needs the places that the catalog is to have")
    sources = list(dict.fromkeys(given if replaces_places else [*known, *given]))
    if not sources:
        raise SourceError("no place is given; name a folder of missions or a store")
    if any(is_store_url(source) for source in sources):
        require("stores")
    found: dict[str, MissionRows] = {}
    failures: list[str] = []
    for source in sources:
        try:
            with missions_at(source) as missions:
                for mission, place in missions:
                    try:
                        rows = mission_rows(mission, place)
                    except (DaemonError, RigError, OSError) as error:
                        failures.append(f"{place}: {error}")
                        continue
                    failures += [f"{place} {f.exposure:06d}: {f.cause}" for f in rows.failures]
                    if rows.mission_id in found:
                        before = found[rows.mission_id].place
                        failures.append(f"{place}: the same mission as {before}; left out")
                        continue
                    found[rows.mission_id] = rows
        except DaemonError as error:
            failures.append(str(error))
    if not found:
        raise SourceError(f"no mission could be read: {'; '.join(failures)}")
    exposures = write_catalog(folder, list(found.values()), sources)
    return CatalogBuild(len(found), exposures, tuple(failures))
