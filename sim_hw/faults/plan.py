"""Which fault happens when and to whom: NAME@TIME[:DEVICE][,DURATION], or a scenario file.

Reading and validation only; all errors are reported at once. `channel` applies the faults.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim_hw import SimulatorError
from sim_hw.faults.catalogue import CATALOGUE, TOPICS, DeviceKind, FaultKind

SCENARIO_MAX_BYTES = 1 << 20
_TEXT = re.compile(
    r"(?P<name>[^@:,]+)@(?P<time>#?[^:,]+)(?::(?P<device>[^,]+))?(?:,(?P<duration>.+))?"
)
_KEYS = frozenset(("fault", "at_s", "at_pulse", "device", "duration_s"))


class FaultPlanError(SimulatorError, ValueError):
    """Faults that cannot be planned; `problems` has one sentence a mistake."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


@dataclass(frozen=True)
class PlannedFault:
    """One fault of one device.

    It begins `at_s` seconds after the devices are ready, or with pulse `at_pulse` of the trigger
    unit (from 1). `duration_s` None: the next message, or until the end; see `FaultKind`. `topic`
    narrows a message fault to some messages of the device, such as "mark".
    """

    name: str
    device: str
    at_s: float | None
    at_pulse: int | None
    duration_s: float | None
    amount: float
    topic: str = ""

    @property
    def kind(self) -> FaultKind:
        return CATALOGUE[self.name]


def read_plan(
    texts: Iterable[str], scenario: Path | None, devices: Mapping[str, DeviceKind]
) -> tuple[PlannedFault, ...]:
    """Faults of the command line and of a scenario file.

    Args:
        texts: NAME@TIME[:DEVICE][,DURATION] each.
        scenario: a TOML file with tables `[[fault]]`; None for none.
        devices: the devices there are, by name.

    Raises:
        FaultPlanError: with a sentence for every mistake in any of them.
    """
    problems: list[str] = []
    planned: list[PlannedFault] = []
    for text in texts:
        entry = _entry_of_text(text, problems)
        if entry is not None:
            planned += _planned(f"--fault {text}", entry, devices, problems)
    if scenario is not None:
        for where, entry in _entries_of_file(scenario, problems):
            planned += _planned(where, entry, devices, problems)
    if problems:
        raise FaultPlanError(problems)
    return tuple(planned)


def _entry_of_text(text: str, problems: list[str]) -> dict[str, Any] | None:
    match = _TEXT.fullmatch(text)
    if match is None:
        problems.append(
            f"--fault {text}: write NAME@TIME[:DEVICE][,DURATION], such as lost@12:SU00 or "
            "silent@#3:receiver,4"
        )
        return None
    entry: dict[str, Any] = {"fault": match["name"]}
    time = match["time"]
    if time.startswith("#"):
        entry["at_pulse"] = int(time[1:]) if time[1:].isdecimal() else time
    else:
        entry["at_s"] = _number(time)
    if match["device"] is not None:
        entry["device"] = match["device"]
    if match["duration"] is not None:
        entry["duration_s"] = _number(match["duration"])
    return entry


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _entries_of_file(path: Path, problems: list[str]) -> list[tuple[str, dict[str, Any]]]:
    try:
        if path.stat().st_size > SCENARIO_MAX_BYTES:
            problems.append(f"{path.name}: too large for a scenario")
            return []
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        problems.append(
            f"{path}: cannot be read ({error.strerror}); give the path of a scenario in TOML"
        )
        return []
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        problems.append(f"{path.name}: not valid TOML: {error}")
        return []
    listed = content.pop("fault", None)
    problems += [
        f"{path.name}: {key} is unknown; a scenario has tables [[fault]]" for key in content
    ]
    if not isinstance(listed, list) or not listed:
        problems.append(f"{path.name}: there is no [[fault]]; a scenario has at least one")
        return []
    found = []
    for index, entry in enumerate(listed):
        where = f"{path.name}: fault[{index}]"
        if isinstance(entry, dict):
            found.append((where, entry))
        else:
            problems.append(f"{where} is no table; write [[fault]]")
    return found


def _planned(
    where: str,
    entry: Mapping[str, Any],
    devices: Mapping[str, DeviceKind],
    problems: list[str],
) -> list[PlannedFault]:
    """The faults an entry asks for: one, or one for every device that can have it."""
    before = len(problems)
    kind = CATALOGUE.get(entry.get("fault", ""))
    if kind is None:
        name = entry.get("fault")
        near = difflib.get_close_matches(str(name), CATALOGUE, 1)
        hint = f"did you mean {near[0]}?" if near else f"one of {', '.join(CATALOGUE)}"
        problems.append(f"{where}: there is no fault {name!r}; {hint}")
        return []
    allowed = _KEYS | ({kind.amount_key} if kind.amount_key else set())
    problems += [
        f"{where}.{key} is not known; {kind.name} has {', '.join(sorted(allowed))}"
        for key in entry
        if key not in allowed
    ]
    at_s, at_pulse = entry.get("at_s"), entry.get("at_pulse")
    if (at_s is None) == (at_pulse is None):
        problems.append(f"{where}: give at_s, seconds from the start, or at_pulse, one of them")
    elif at_s is not None and not _is_number(at_s, least=0.0):
        problems.append(f"{where}.at_s is {at_s!r}; seconds from the start, 0 or more")
    elif at_pulse is not None and not (_is_integer(at_pulse) and at_pulse >= 1):
        problems.append(f"{where}.at_pulse is {at_pulse!r}; the number of a pulse, from 1")
    duration_s = entry.get("duration_s", kind.duration_s)
    if duration_s is not None and not (_is_number(duration_s, least=0.0) and duration_s > 0):
        problems.append(f"{where}.duration_s is {duration_s!r}; a number of seconds above 0")
    amount = entry.get(kind.amount_key, kind.amount) if kind.amount_key else 0.0
    if not _is_number(amount):
        problems.append(f"{where}.{kind.amount_key} is {amount!r}; a number")
    elif kind.name == "late" and amount <= 0:
        problems.append(f"{where}.by_s is {amount!r}; a message cannot arrive before it is sent")
    elif kind.name == "wrong-week" and amount != int(amount):
        problems.append(f"{where}.weeks is {amount!r}; a whole number of weeks")
    targets = _targets(where, entry.get("device"), kind, devices, problems)
    if len(problems) > before:
        return []
    return [
        PlannedFault(kind.name, device, at_s, at_pulse, duration_s, float(amount), topic)
        for device, topic in targets
    ]


def _targets(
    where: str,
    device: object,
    kind: FaultKind,
    devices: Mapping[str, DeviceKind],
    problems: list[str],
) -> list[tuple[str, str]]:
    """Device and topic: the one that is named, or all that can have the fault."""
    fitting = [name for name, of in devices.items() if of in kind.devices]
    if device is None:
        if not fitting:
            problems.append(f"{where}: no device here can have {kind.name}")
        return [(name, "") for name in fitting]
    if not isinstance(device, str):
        problems.append(f"{where}.device is {device!r}; the name of a device in quotes")
        return []
    name, _, topic = device.partition("/")
    if name not in devices:
        problems.append(
            f"{where}: there is no device {name!r}; {kind.name} can be had by {', '.join(fitting)}"
        )
    elif name not in fitting:
        problems.append(
            f"{where}: {name} is a {devices[name]}, which cannot have {kind.name}; it can be had "
            f"by {', '.join(fitting) or 'no device here'}"
        )
    elif topic and kind.level != "message":
        problems.append(f"{where}: {kind.name} is of the whole device; leave out /{topic}")
    elif topic and topic not in TOPICS.get(devices[name], ()):
        known = " or ".join(f"{name}/{one}" for one in TOPICS.get(devices[name], ()))
        problems.append(f"{where}: {device} is not a message; write {known or name}")
    return [(name, topic)]


def _is_number(value: object, *, least: float = -math.inf) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
        and value >= least
    )


def _is_integer(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
