"""Coordination of storing frames and sealing records, and of the results.

One record is with the writer at a time, so that the chain of hashes has one order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from daemon.mission.canonical_json import canonical_bytes
from daemon.mission.exposure import Exposure
from daemon.mission.log.log_records import Message
from daemon.mission.verification.recovery import LEDGER_TOPIC
from daemon.onboard.flight.decisions import Decision, Kind
from daemon.onboard.flight.flight import Flight, PendingStore
from daemon.onboard.pipeline.pipeline_queue import PipelineQueue
from daemon.onboard.service.message_dispatcher import MessageDispatcher
from daemon.onboard.service.messages import AppendToLog, Seal, Sealed, Store, Stored, WriteFailed
from daemon.onboard.service.monitoring_link import summary
from daemon.onboard.service.record_ingest import EmitEvent

SEAL_RETRY_NS = 1_000_000_000
"""Delay before a refused record is retried."""


class StorageCoordinator(MessageDispatcher):
    """Passes exposures to the writer, and reports to flight and pipeline what is on disk.

    Args:
        flight: the open exposures and the ledger.
        pipeline: receives stored and sealed exposures.
        send: sends a message to a process, by its name.
        emit: emits the event of each result.
        on_decision: called when an exposure is stored or sealed.
    """

    def __init__(
        self,
        flight: Flight,
        pipeline: PipelineQueue,
        send: Callable[[str, object], None],
        emit: EmitEvent,
        on_decision: Callable[[Decision], None],
    ) -> None:
        self._flight = flight
        self._pipeline = pipeline
        self._send = send
        self._emit = emit
        self._on_decision = on_decision
        self._sealing: Exposure | None = None
        self._retry_after_ns = 0

    @property
    def is_sealing(self) -> bool:
        """Whether a record is with the writer."""
        return self._sealing is not None

    def may_seal(self, now_ns: int) -> bool:
        """Whether the writer may be given a record at this monotonic instant."""
        return self._sealing is None and now_ns >= self._retry_after_ns

    def store(self, waiting: PendingStore) -> None:
        """Have the writer store an exposure's frames; they stay in memory for the pipeline."""
        self._pipeline.retain(waiting.capture.number, waiting.slots)
        self._send("writer", Store(waiting.capture, waiting.slots))

    def seal(self, exposure: Exposure) -> None:
        """Have the writer seal an exposure's record; only where it `may_seal`."""
        self._sealing = exposure
        self._send("writer", Seal(exposure))

    def _on_stored(self, stored: Stored) -> None:
        self._flight.stored(stored.number, stored.frames, stored.disks)
        where = {"disks": list(stored.disks)} if stored.disks else {}
        self._decide("stored", stored.number, where)
        duration_s = round(stored.duration_s, 4)
        self._emit("stored", number=stored.number, duration_s=duration_s, **where)
        self._pipeline.stored(stored.number)

    def _on_sealed(self, sealed: Sealed) -> None:
        exposure, self._sealing = self._sealing, None
        assert exposure is not None and exposure.number == sealed.number
        self._flight.sealed(sealed.number, exposure.state)
        self._decide("sealed", sealed.number)
        sheet = canonical_bytes(self._flight.ledger.sheet().as_json())
        self._send("writer", AppendToLog(Message(LEDGER_TOPIC, time.monotonic_ns(), sheet)))
        if exposure.state == "lost":
            return
        self._emit("sealed", **summary(exposure))
        self._pipeline.sealed(exposure)

    def _on_write_failed(self, failed: WriteFailed) -> None:
        self._emit("not-written", number=failed.number, sentence=failed.sentence)
        if self._sealing is not None and self._sealing.number == failed.number:
            self._not_sealed(self._sealing, failed)
            self._sealing = None
        else:
            self._pipeline.not_stored(failed.number)
            self._flight.not_stored(failed.number, failed.sentence)
            self._emit("lost", number=failed.number, cause=failed.sentence)
            self._decide("not-stored", failed.number, {"sentence": failed.sentence})

    def _not_sealed(self, exposure: Exposure, failed: WriteFailed) -> None:
        if failed.is_transient:
            self._retry_after_ns = time.monotonic_ns() + SEAL_RETRY_NS
        else:
            # Recovery seals it from the log when the service starts next.
            self._flight.not_sealed(exposure.number, exposure.state)
            self._pipeline.not_sealed(exposure.number)
            self._decide("not-sealed", exposure.number)

    def _decide(self, kind: Kind, number: int, detail: Mapping[str, Any] | None = None) -> None:
        self._on_decision(Decision(kind, time.monotonic_ns(), number, detail or {}))

    handlers: ClassVar = {
        Stored: _on_stored,
        Sealed: _on_sealed,
        WriteFailed: _on_write_failed,
    }
