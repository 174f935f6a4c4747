"""The worker sends a verdict early, and writes products of sealed records only."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from daemon.mission.exposure import Exposure
from daemon.onboard.pipeline import worker
from daemon.onboard.service.messages import Process, Processed, RecordFinalized, VerdictReady
from daemon.planning.overlaps import OverlapShares
from processing.quality.report import Flag

PROVISIONAL = Exposure(number=1, mark_source="event-mark")
OTHERWISE = Exposure(number=1, mark_source="interpolated")


class Bench:
    """A worker context whose products are the source of an exposure's time; records its output."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: list[Any] = []
        self.written: list[Any] = []
        self.flags: list[Flag] = []
        overlaps = SimpleNamespace(add=lambda _: None, of=lambda _: OverlapShares())
        mission = SimpleNamespace(
            path=Path("m"), level0=lambda _: Path("L0"), level2=lambda _: Path("L2")
        )
        nothing = dict.fromkeys(("rig", "mount", "plan", "ground"))
        about: dict[str, Any] = {"link": self, "mission": mission, "overlaps": overlaps}
        self.context = worker.WorkerContext(rings=(), **cast(Any, nothing), **about)
        monkeypatch.setattr(worker.store, "load_level0", lambda *_: ({}, ()))
        monkeypatch.setattr(worker, "histograms_of", lambda *_: {})
        monkeypatch.setattr(worker, "conditions_of", self._conditions)
        monkeypatch.setattr(worker, "make_products", _products)
        monkeypatch.setattr(worker.level2, "write_folder", self._write)

    def send(self, message: object) -> None:
        self.sent.append(message)

    def _conditions(self, *arguments: Any, **_: Any) -> None:
        self.flags.append(arguments[3])

    def _write(self, _folder: Path, contents: Any) -> dict[str, int]:
        self.written.append(contents)
        return {}

    def work(self, finalized: RecordFinalized | None) -> None:
        """One unsealed exposure that is finalized so, or not before the end."""
        order = Process(PROVISIONAL, None, is_sealed=False)
        self.context.begin(order)
        if finalized is not None:
            self.context.finalize(finalized)
        self.context.abandon_pending()
        self.context.process(order, OverlapShares(), cast(Any, None))

    @property
    def verdicts(self) -> list[str]:
        return [one.report["source"] for one in self.sent if isinstance(one, VerdictReady)]


def _products(
    _processor: Any, _mount: Any, _plan: Any, exposure: Exposure, *_: Any, **__: Any
) -> Any:
    return {"source": exposure.mark_source}, exposure.mark_source


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_products_of_a_confirmed_provisional_record_are_written(bench: Bench) -> None:
    bench.work(RecordFinalized(1, PROVISIONAL))
    assert bench.verdicts == ["event-mark"] and bench.written == ["event-mark"]
    assert isinstance(bench.sent[-1], Processed)


def test_products_of_a_changed_record_are_computed_and_reported_again(bench: Bench) -> None:
    bench.work(RecordFinalized(1, OTHERWISE))
    assert bench.verdicts == ["event-mark", "interpolated"] and bench.written == ["interpolated"]


@pytest.mark.parametrize("finalized", [RecordFinalized(1, None), None])
def test_what_is_never_sealed_is_never_written(
    bench: Bench, finalized: RecordFinalized | None
) -> None:
    bench.work(finalized)
    assert bench.verdicts == ["event-mark"] and bench.written == []
    assert not any(isinstance(one, Processed) for one in bench.sent)


@pytest.mark.parametrize(("slots", "flag"), [({}, Flag(0)), (None, Flag.PROCESSING_BEHIND)])
def test_what_had_to_be_read_from_disk_was_behind(
    bench: Bench, slots: dict[str, int] | None, flag: Flag
) -> None:
    bench.context.process(Process(PROVISIONAL, slots), OverlapShares(), cast(Any, None))
    assert bench.flags == [flag]
