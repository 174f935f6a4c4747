"""One run of the service again, from its flight log: matching, clocks, ledger and records.

Instants and decisions are those of the log; what follows from them is computed again and compared
with what the flight found. Pixels are the business of
`daemon.postflight.replay.product_comparison`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from daemon.configuration.model import Configuration
from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.exposure import CaptureRecord, Exposure, FrameRecord
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import read
from daemon.mission.log.log_records import (
    LoggedRecord,
    LoggedTrigger,
    Message,
    message_of,
    record_of,
)
from daemon.mission.store.level0_folder import hash_file
from daemon.mission.verification.recovery import LEDGER_TOPIC
from daemon.onboard.capture.devices import device_specs
from daemon.onboard.flight.decisions import Decision, decision_of
from daemon.onboard.flight.flight import Flight
from daemon.onboard.flight.flight_identity import FlightIdentity
from daemon.onboard.flight.ledger import Ledger
from daemon.onboard.flight.recovery_match import pulse_of
from daemon.postflight.replay.codecs import Decoded, codec_for, decode_all, has_first_bytes
from drivers.contract import (
    ClockReading,
    DeviceEvent,
    EventMark,
    NavSample,
    RawBytes,
    TemperatureSample,
)
from processing.quality.report import Flag
from processing.rig import Rig

IdentityFactory = Callable[[str], FlightIdentity]
"""Identity repeated in every record of a run, by the boot its log names."""


@dataclass
class ReplayResult:
    """Result of replaying a run.

    `records` are the sealed exposures in their order; `deferred` those the pipeline read from disk
    in the air. `agreements` and `disagreements` count by what was compared; `sentences` say more of
    what disagrees.
    """

    records: list[Exposure] = field(default_factory=list)
    deferred: dict[int, bool] = field(default_factory=dict)
    agreements: Counter[str] = field(default_factory=Counter)
    disagreements: Counter[str] = field(default_factory=Counter)
    sentences: list[str] = field(default_factory=list)
    is_complete: bool = False

    @property
    def agrees(self) -> bool:
        """Whether something was compared and nothing differs."""
        return bool(self.agreements) and not self.disagreements

    def add(self, other: ReplayResult) -> None:
        """Take in another run of the same mission."""
        self.records += other.records
        self.deferred |= other.deferred
        self.agreements += other.agreements
        self.disagreements += other.disagreements
        self.sentences += other.sentences
        self.is_complete = self.is_complete and other.is_complete

    def as_json(self) -> dict[str, Any]:
        """The comparisons, as plain JSON types."""
        names = sorted(self.agreements.keys() | self.disagreements.keys())
        return {
            "agrees": self.agrees,
            "exposures": len(self.records),
            "deferred": sum(self.deferred.values()),
            "compared": [
                {"what": n, "equal": self.agreements[n], "different": self.disagreements[n]}
                for n in names
            ],
            "sentences": self.sentences,
        }

    def compare(self, what: str, *, agrees: bool, sentence: str = "") -> None:
        """Count one comparison."""
        (self.agreements if agrees else self.disagreements)[what] += 1
        if not agrees and sentence:
            self.sentences.append(sentence)


def replay_log(
    log: Path, mission: Mission, rig: Rig, configuration: Configuration, identity: IdentityFactory
) -> ReplayResult:
    """Replay one run of the service.

    A log of a service that did not record its decisions gives nothing but what its codecs say.
    """
    reader = read(log)
    messages = list(reader)
    out = ReplayResult(is_complete=reader.is_complete)
    decoded = _decode(messages, configuration, rig, out)
    begin = next((d for m in messages if (d := decision_of(m)) and d.kind == "begin"), None)
    if begin is None:
        out.sentences.append(f"{log.name}: holds no decisions; its records are not replayed")
        return out
    run_identity = replace(identity(reader.boot_id), software=str(begin.detail.get("software", "")))
    heads = [head.sensor for head in configuration.head]
    flight = Flight(
        rig,
        {head: rig.sensor(head).serial for head in heads},
        run_identity,
        configuration.limits,
        Ledger(heads=heads),
        begin.number,
    )
    run = _Run(flight, mission, out)
    for message in messages:
        run.take(message, decoded)
    if not begin.detail.get("resumed") and run.sheet is not None:
        run.compare_ledger()
    return out


class _Run:
    """The pieces that fly, driven by the log."""

    def __init__(self, flight: Flight, mission: Mission, out: ReplayResult) -> None:
        self._flight = flight
        self._mission = mission
        self._out = out
        self._captures: dict[int, CaptureRecord] = {}
        self.sheet: Mapping[str, Any] | None = None
        self._current_sheet: Mapping[str, Any] = {}

    def take(self, message: Message, decoded: Mapping[int, Decoded]) -> None:
        """The next message of the log."""
        if message.topic == LEDGER_TOPIC:
            try:
                self.sheet = parse_record(message.payload, message.topic)
            except RecordError:
                return
            self._current_sheet = self._flight.ledger.sheet().as_json()
            return
        decision = decision_of(message)
        if decision is not None:
            self._decide(decision)
            return
        record: LoggedRecord | Decoded | None = decoded.get(id(message)) or record_of(message)
        if isinstance(record, LoggedTrigger):
            self._flight.fired(pulse_of(record))
        elif record is not None:
            self._flight.take(record)

    def compare_ledger(self) -> None:
        """The sheet after the last seal, against the one that was logged then."""
        agrees = dict(self.sheet or {}) == dict(self._current_sheet)
        sentence = "the ledger's sheet after the last seal differs from the flight's"
        self._out.compare("ledger", agrees=agrees, sentence=sentence)

    def _decide(self, decision: Decision) -> None:
        handler = _HANDLERS.get(decision.kind)
        if handler is not None:
            handler(self, decision)

    def _order(self, decision: Decision) -> None:
        detail = decision.detail
        self._flight.disk_is_low = bool(int(detail.get("flags", 0)) & Flag.DISK_LOW)
        line_id, strip_id = str(detail.get("line_id", "")), str(detail.get("strip_id", ""))
        number = self._flight.order(decision.mono_ns, line_id, strip_id)
        self._out.compare("order", agrees=number == decision.number)

    def _not_fired(self, decision: Decision) -> None:
        self._flight.not_fired(decision.number, str(decision.detail.get("sentence", "")))

    def _advance(self, decision: Decision) -> None:
        due = self._flight.advance(decision.mono_ns)
        self._captures |= {one.capture.number: one.capture for one in due.store}
        found = {} if due.decision is None else due.decision.detail
        for key, what in _COMPARED.items():
            original = decision.detail.get(key)
            sentence = f"{what}: {found.get(key)} fell due where the flight had {original}"
            if original:
                self._out.compare(what, agrees=found.get(key) == original, sentence=sentence)
            elif found.get(key):
                self._out.compare(what, agrees=False, sentence=sentence)

    def _stored(self, decision: Decision) -> None:
        capture = self._captures.pop(decision.number, None)
        if capture is None:
            return
        folder = self._mission.level0(decision.number)
        frames = tuple(_on_disk(folder, frame) for frame in capture.frames)
        disks = tuple(map(str, decision.detail.get("disks", ())))
        self._flight.stored(decision.number, frames, disks)

    def _not_stored(self, decision: Decision) -> None:
        self._flight.not_stored(decision.number, str(decision.detail.get("sentence", "")))

    def _sealed(self, decision: Decision) -> None:
        if not self._is_sealing(decision):
            sentence = f"exposure {decision.number} was sealed in flight and is not in the replay"
            self._out.compare("seals", agrees=False, sentence=sentence)
            return
        self._out.records.append(self._flight.sealed(decision.number))

    def _not_sealed(self, decision: Decision) -> None:
        if self._is_sealing(decision):
            self._flight.not_sealed(decision.number)

    def _seal_refused(self, decision: Decision) -> None:
        self._flight.seal_refused(decision.mono_ns)

    def _timeouts_expired(self, _decision: Decision) -> None:
        self._flight.expire_timeouts()

    def _is_sealing(self, decision: Decision) -> bool:
        sealing = self._flight.sealing
        return sealing is not None and sealing.number == decision.number

    def _process(self, decision: Decision) -> None:
        self._out.deferred[decision.number] = bool(decision.detail.get("deferred"))


_COMPARED = {"store": "stores", "lost": "lost", "seal": "seals", "provisional": "provisional"}
_HANDLERS: Mapping[str, Callable[[_Run, Decision], None]] = {
    "order": _Run._order,
    "not-fired": _Run._not_fired,
    "advance": _Run._advance,
    "stored": _Run._stored,
    "not-stored": _Run._not_stored,
    "sealed": _Run._sealed,
    "not-sealed": _Run._not_sealed,
    "seal-refused": _Run._seal_refused,
    "timeouts-expired": _Run._timeouts_expired,
    "process": _Run._process,
}


def _on_disk(folder: Path, frame: FrameRecord) -> FrameRecord:
    """The frame with the present state of its file."""
    name = f"{frame.sensor}.tif"
    try:
        return replace(frame, file=name, sha256=hash_file(folder / name))
    except OSError:
        return replace(frame, file=name, sha256="missing")


def _decode(
    messages: Iterable[Message], configuration: Configuration, rig: Rig, out: ReplayResult
) -> dict[int, Decoded]:
    """Records decoded from the logged bytes, by the message they replace.

    A record arrives when the flight's did; its content comes from the bytes.
    """
    recorded: dict[str, list[RawBytes | DeviceEvent]] = defaultdict(list)
    expected: dict[str, list[tuple[Message, Decoded]]] = defaultdict(list)
    specs = {spec.name: spec for spec in device_specs(configuration, rig)}
    probes = {
        str(probe): spec.name
        for spec in specs.values()
        for probe in _listed(spec.settings.get("channels"))
    }
    for message in messages:
        kind, _, name = message.topic.partition("/")
        if kind == "raw":
            recorded[name].append(RawBytes(name, message.mono_ns, message.payload))
            continue
        record = record_of(message)
        if isinstance(record, DeviceEvent):
            recorded[record.device].append(record)
        elif isinstance(record, NavSample | EventMark):
            expected[name].append((message, record))
        elif isinstance(record, TemperatureSample):
            expected[probes.get(name, "")].append((message, record))
    decoded: dict[int, Decoded] = {}
    for name, spec in specs.items():
        has_bytes = any(isinstance(record, RawBytes) for record in recorded[name])
        codec = codec_for(spec.kind, spec.driver, name, spec.settings) if has_bytes else None
        if codec is None:
            continue
        what = f"records of {name}"
        # A clock reading answers a request, whose time is not among the bytes.
        found = [r for r in decode_all(codec, recorded[name]) if not isinstance(r, ClockReading)]
        pairs = [
            (message, original, replace(again, mono_ns=original.mono_ns))
            for (message, original), again in zip(expected[name], found, strict=False)
        ]
        agree = [message_of(again).payload == message.payload for message, _, again in pairs]
        first = 0 if has_first_bytes(recorded[name]) or True not in agree else agree.index(True)
        if first:
            out.sentences.append(
                f"{what}: the log does not hold what {name} sent before it was open, which early "
                f"versions did not log; the first {first} after it are taken as logged"
            )
        for (message, original, again), agrees in zip(pairs[first:], agree[first:], strict=True):
            sentence = f"{what}: {again} where the flight had {original}"
            out.compare(what, agrees=agrees, sentence=sentence)
            decoded[id(message)] = again
        # The last bytes may have been decoded after the log was closed.
        short = len(expected[name]) - len(found)
        if short > 0:
            out.disagreements[what] += short
            out.sentences.append(f"{what}: {short} of {len(expected[name])} are not in its bytes")
    return decoded


def _listed(value: object) -> tuple[object, ...]:
    return tuple(value) if isinstance(value, list | tuple) else ()
