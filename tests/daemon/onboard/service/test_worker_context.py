"""The worker sends a verdict early, and publishes products of sealed records only."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from daemon.mission.exposure import Exposure
from daemon.onboard.pipeline import worker
from daemon.onboard.service.messages import (
    Process,
    Processed,
    ProcessFailed,
    ProductsStaged,
    RecordFinalized,
    VerdictReady,
)
from daemon.planning.overlaps import OverlapShares
from daemon.products.exposure_products import ExposureProducts
from processing.quality.report import Flag

PROVISIONAL = Exposure(number=1, mark_source="event-mark")


class Bench:
    """A worker context whose products are the source of an exposure's time; records its output."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.sent: list[Any] = []
        self.flags: list[Flag] = []
        self.level2 = folder / "L2" / "000001"
        overlaps = SimpleNamespace(add=lambda _: None, of=lambda _: OverlapShares())
        nothing = dict.fromkeys(("rig", "geometry"))
        about: dict[str, Any] = {"link": self, "overlaps": overlaps}
        about["mission"] = self.mission(folder)
        self.context = worker.WorkerContext(rings=(), **cast(Any, nothing), **about)
        monkeypatch.setattr(worker.store, "load_level0", lambda *_: ({}, ()))
        monkeypatch.setattr(worker, "make_products", self._products)
        monkeypatch.setattr(worker, "report_unprocessed", lambda *_: {})

    def mission(self, folder: Path) -> Any:
        return SimpleNamespace(
            path=folder, level0=lambda _: Path("L0"), level2=lambda _: folder / "L2" / "000001"
        )

    def send(self, message: object) -> None:
        self.sent.append(message)

    def _products(self, *arguments: Any, **_: Any) -> ExposureProducts:
        exposure, flags = arguments[2], arguments[4]
        self.flags.append(flags)
        source = exposure.mark_source
        contents: dict[str, Any] = {"quality.json": [source.encode()]}
        return ExposureProducts({"source": source}, contents, {"A": (1,)})

    def process(self, slots: Mapping[str, int] | None = None, *, is_sealed: bool = False) -> None:
        message = Process(PROVISIONAL, slots, is_sealed=is_sealed)
        self.context.process(message, OverlapShares(), cast(Any, None))

    @property
    def kinds(self) -> list[type]:
        return [type(message) for message in self.sent]

    @property
    def published(self) -> list[str]:
        """Names in the folder of Level-2, the part folders of staged products among them."""
        return sorted(path.name for path in self.level2.parent.iterdir())


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bench:
    return Bench(monkeypatch, tmp_path)


def test_products_of_a_sealed_record_are_published_at_once(bench: Bench) -> None:
    bench.process(is_sealed=True)
    assert bench.kinds == [VerdictReady, Processed]
    assert bench.published == ["000001"]
    assert bench.sent[-1].files == {"quality.json": len("event-mark")}


def test_products_of_a_provisional_record_wait_on_disk_and_hold_no_processor(bench: Bench) -> None:
    bench.process()
    assert bench.kinds == [VerdictReady, ProductsStaged]
    (staged,) = bench.published
    assert staged.endswith(".part")
    bench.context.finalize(RecordFinalized(1, is_confirmed=True))
    assert bench.kinds[2:] == [Processed] and bench.published == ["000001"]


def test_a_record_that_is_final_before_the_products_are_computed_needs_no_second_step(
    bench: Bench,
) -> None:
    bench.context.finalize(RecordFinalized(1, is_confirmed=True))
    assert bench.sent == []
    bench.process()
    assert bench.kinds == [VerdictReady, Processed] and bench.published == ["000001"]


@pytest.mark.parametrize("is_first", [False, True])
def test_products_of_another_record_are_dropped(bench: Bench, is_first: bool) -> None:
    steps = [bench.process, lambda: bench.context.finalize(RecordFinalized(1, is_confirmed=False))]
    for step in reversed(steps) if is_first else steps:
        step()
    assert Processed not in bench.kinds and bench.published == []
    bench.process(is_sealed=True)
    assert bench.published == ["000001"]


def test_what_is_never_sealed_is_never_published(bench: Bench) -> None:
    bench.process()
    bench.context.drop_staged()
    assert bench.kinds == [VerdictReady, ProductsStaged] and bench.published == []


def test_products_staged_on_a_disk_that_leads_no_longer_are_not_published(
    bench: Bench, tmp_path: Path
) -> None:
    bench.process()
    bench.context.mission = bench.mission(tmp_path / "other")
    bench.context.finalize(RecordFinalized(1, is_confirmed=True))
    assert bench.kinds[-1] is ProcessFailed and bench.published == []
    assert "run syntopic process" in bench.sent[-1].sentence


def test_a_disk_that_refuses_the_products_costs_them_and_nothing_else(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(worker.level2.direct_io, "create_file", refuse)
    bench.process(is_sealed=True)
    assert bench.kinds == [VerdictReady, ProcessFailed] and bench.published == []


@pytest.mark.parametrize("attempt", range(20))
def test_products_and_their_record_may_come_at_the_same_time(bench: Bench, attempt: int) -> None:
    both = threading.Barrier(2)

    def finalize() -> None:
        both.wait(timeout=10)
        bench.context.finalize(RecordFinalized(1, is_confirmed=attempt % 2 == 0))

    thread = threading.Thread(target=finalize)
    thread.start()
    both.wait(timeout=10)
    bench.process()
    thread.join(timeout=10)
    assert bench.published == (["000001"] if attempt % 2 == 0 else [])
    assert (Processed in bench.kinds) is (attempt % 2 == 0)


@pytest.mark.parametrize(("slots", "flag"), [({}, Flag(0)), (None, Flag.PROCESSING_BEHIND)])
def test_what_had_to_be_read_from_disk_was_behind(
    bench: Bench, slots: dict[str, int] | None, flag: Flag
) -> None:
    bench.process(slots, is_sealed=True)
    assert bench.flags == [flag]
