"""Where `syntopic process` reads a mission and publishes its products: a folder, or a store."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.mission.store.level2 import recover_level2
from daemon.mission.transfer.object_store import is_store_url
from daemon.mission.transfer.s3_uploads import abort_unfinished
from daemon.mission.transfer.store_mission import StoredMission, open_stored
from daemon.mission.transfer.store_products import PROCESSED, is_processed, stored_reports
from daemon.planning.overlaps import Overlaps
from daemon.postflight.batch.batch_run import BatchOutcome
from daemon.postflight.batch.level2_work import (
    Level2Survey,
    Level2Work,
    replaced_meanwhile,
    report_of,
    survey,
)
from daemon.postflight.batch.store_level2 import StoreLevel2Work, survey_stored

AnyLevel2Work: TypeAlias = Level2Work | StoreLevel2Work


class Level2Source(Protocol):
    """A mission and the place of its products.

    `mission` is a folder here, without the frames of a mission in a store; `place`, `products` and
    `note`, what was found before the run, are for messages.
    """

    mission: Mission
    place: str
    products: str
    note: str

    def placed(self, work: Level2Work) -> AnyLevel2Work:
        """The work that reads and publishes there."""

    def survey(
        self, work: AnyLevel2Work, numbers: Sequence[int], overlaps: Overlaps
    ) -> Level2Survey:
        """What is complete and what has to be computed."""

    def reports(self, complete: Mapping[int, str]) -> dict[int, dict[str, Any]]:
        """Quality reports of complete products by exposure."""

    def replaced(self, found: Level2Survey, outcome: BatchOutcome) -> list[ExposureFailure]:
        """Exposures whose products another run replaced meanwhile."""

    @contextmanager
    def writing(self) -> Iterator[None]:
        """The mission is written to in the block."""


class FolderSource:
    """A mission in a folder."""

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.place, self.products = str(mission.path), str(mission.level2_root)
        self.note = ""

    def placed(self, work: Level2Work) -> AnyLevel2Work:
        return work

    def survey(
        self, work: AnyLevel2Work, numbers: Sequence[int], overlaps: Overlaps
    ) -> Level2Survey:
        assert isinstance(work, Level2Work)
        return survey(work, self.mission, numbers, overlaps)

    def reports(self, complete: Mapping[int, str]) -> dict[int, dict[str, Any]]:
        return {number: report_of(self.mission, number, key) for number, key in complete.items()}

    def replaced(self, found: Level2Survey, outcome: BatchOutcome) -> list[ExposureFailure]:
        return replaced_meanwhile(self.mission, found, outcome)

    @contextmanager
    def writing(self) -> Iterator[None]:
        with self.mission.held(is_shared=True):
            recover_level2(self.mission)
            yield


class StoreSource:
    """A transferred mission in an object store; nothing of it is written but its products."""

    def __init__(self, stored: StoredMission, mission: Mission) -> None:
        self.mission, self._stored = mission, stored
        self.place = stored.store.url
        self.products = f"{stored.store.url}/{PROCESSED}/L2"
        self.note = ""

    def placed(self, work: Level2Work) -> AnyLevel2Work:
        return StoreLevel2Work(self.place, work)

    def survey(
        self, work: AnyLevel2Work, numbers: Sequence[int], overlaps: Overlaps
    ) -> Level2Survey:
        assert isinstance(work, StoreLevel2Work)
        return survey_stored(work, self._stored, self.mission, numbers, overlaps)

    def reports(self, complete: Mapping[int, str]) -> dict[int, dict[str, Any]]:
        return stored_reports(self._stored.store, complete)

    def replaced(self, found: Level2Survey, outcome: BatchOutcome) -> list[ExposureFailure]:
        return []  # products of other settings have another key, and another place

    @contextmanager
    def writing(self) -> Iterator[None]:
        self.note = abort_unfinished(self.place, is_processed).sentence
        yield


@contextmanager
def level2_source(place: str) -> Iterator[Level2Source]:
    """The mission at a place, for as long as the block lasts.

    Args:
        place: a mission folder, or the address of a transferred mission in a store.

    Raises:
        MissionError: no mission in the folder.
        ObjectStoreError: the store refused, or has no complete mission there.
    """
    if not is_store_url(place):
        yield FolderSource(Mission.open(Path(place)))
        return
    stored = open_stored(place)
    with tempfile.TemporaryDirectory(prefix="syntopic-process-") as scratch:
        # All records are read: an exposure's overlaps are with all others.
        yield StoreSource(stored, stored.fetch(Path(scratch), stored.exposures))
