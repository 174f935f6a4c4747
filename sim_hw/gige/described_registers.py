"""Registers of a camera that is given by its GenICam description.

Every register of the description has its own storage. A write is refused where the description
states that the feature is read-only, locked or not available, or that the value is out of bounds.
"""

from __future__ import annotations

import contextlib
import ipaddress
import itertools
import struct
import threading
from collections import defaultdict
from typing import Literal

from sim_hw.gige import features as at
from sim_hw.gige.genicam.description_file import Description, Node
from sim_hw.gige.genicam.node_map import (
    INTEGER_REGISTERS,
    REGISTERS,
    NodeError,
    NodeMap,
    bit_field,
    is_big_endian,
)
from sim_hw.gige.genicam.power_on_state import (
    InitialState,
    controller_selectors,
    features_of,
    write_power_on_state,
)
from sim_hw.gige.gvcp import Status
from sim_hw.gige.registers import HeadIdentity, RegisterRefusedError

COMMANDS = (
    *("AcquisitionStart", "AcquisitionStop", "TriggerSoftware"),
    *("TimestampLatch", "GevTimestampControlLatch", "TimestampControlLatch"),
)
"""Commands that the emulated head executes."""
_CHOICES_MAX = 64
XML_START = 0x7000_0000
"""Address of the description; no known camera has registers from here on."""

TICK_FREQUENCY_HZ = 1_000_000_000
HEARTBEAT_TIMEOUT_MS = 3000
_BOOTSTRAP_END = 0xA000
_ADDRESS_MASK = 0xFFFF_FFFF
_TOLERANCE = 1e-6
_CHAIN_MAX = 50
_SELECTED_RANGE_NBYTES = 0x1000
_BOUNDED = frozenset({"Integer", "Float", "Enumeration"})


class SparseMemory:
    """Bytes by address; what was never written is zero. Addresses are those of 32 bits."""

    def __init__(self) -> None:
        self._words: dict[int, bytearray] = {}

    def read(self, address: int, length: int) -> bytes:
        return bytes(self._byte(address + index) for index in range(length))

    def write(self, address: int, data: bytes) -> None:
        for index, value in enumerate(data):
            place = (address + index) & _ADDRESS_MASK
            self._words.setdefault(place >> 2, bytearray(4))[place & 3] = value

    def _byte(self, address: int) -> int:
        word = self._words.get((address & _ADDRESS_MASK) >> 2)
        return 0 if word is None else word[address & 3]


class DescribedRegisters:
    """Registers by address, as `sim_hw.gige.control` needs them. Thread-safe.

    Args:
        identity: the address and strings the camera reports.
        description: the camera's description.
        state: what the registers hold at power-on.
    """

    def __init__(
        self, identity: HeadIdentity, description: Description, state: InitialState
    ) -> None:
        self._identity = identity
        self._state = state
        self.lock = threading.RLock()
        self._stored = description.stored + bytes(-len(description.stored) % 4)
        self._description = description
        self.refused: list[str] = []
        """Names of the registers whose writes were refused, in order."""
        self.reset()
        self._writers = self._find_writers()
        self._fixed, self._moving = self._place_registers()
        self._choices = self._find_choices()
        self._selected = self._place_selected()

    def reset(self) -> None:
        """Write what the camera holds at power-on."""
        with self.lock:
            self.memory = SparseMemory()
            self.nodes = NodeMap(self._description, self.memory)
            write_power_on_state(self.nodes, self._state)
            self._write_bootstrap()
            self.nodes.invalidate()

    def read(self, address: int, length: int) -> bytes:
        """Bytes of `length` from `address`."""
        if address % 4 or length % 4 or length <= 0:
            raise RegisterRefusedError(Status.BAD_ALIGNMENT)
        with self.lock:
            if XML_START <= address < XML_START + len(self._stored):
                part = self._stored[address - XML_START :][:length]
                return part.ljust(length, b"\0")
            if address >= _BOOTSTRAP_END and not self._owners(address, length):
                raise RegisterRefusedError(Status.INVALID_ADDRESS)
            return self.memory.read(address, length)

    def write(self, address: int, data: bytes, *, acquiring: bool = False) -> None:
        """Write a register as the description allows it; nothing is half written."""
        if address % 4 or len(data) % 4 or not data:
            raise RegisterRefusedError(Status.BAD_ALIGNMENT)
        with self.lock:
            if "TLParamsLocked" in self.nodes.nodes:
                self.nodes.set_local("TLParamsLocked", int(acquiring))
            owners = self._owners(address, len(data))
            if not owners:
                if address >= _BOOTSTRAP_END:
                    raise RegisterRefusedError(Status.INVALID_ADDRESS)
            else:
                self._check_access(owners, address, data)
            before = self.memory.read(address, len(data))
            limited = self._within_limits(owners)
            self.memory.write(address, data)
            self.nodes.invalidate()
            outside = limited - self._within_limits(owners)
            if outside:
                self.memory.write(address, before)
                self.nodes.invalidate()
                self.refused.append(", ".join(sorted(outside)))
                raise RegisterRefusedError(Status.INVALID_PARAMETER)

    def register(self, address: int) -> int:
        """The 32-bit register at an address."""
        return int(struct.unpack(">I", self.memory.read(address, 4))[0])

    def set_register(self, address: int, value: int) -> None:
        """Set a register from inside."""
        with self.lock:
            self.memory.write(address, struct.pack(">I", value & 0xFFFF_FFFF))
            self.nodes.invalidate()

    def set_feature(self, name: str, value: float) -> bool:
        """Set a feature from inside; whether the description has a register for it."""
        with self.lock:
            try:
                self.nodes.write(name, value)
            except (NodeError, OverflowError, ValueError):
                return False
            return True

    def set_parts(self, name: str, value: int) -> None:
        """Set a feature that is a formula of one register, or of two of 16 bits."""
        with self.lock:
            sources = sorted(self.nodes.references(name)) if name in self.nodes.nodes else []
            parts = [part for source in sources for part in sorted(self.nodes.references(source))]
            whole = [((part, value),) for part in parts]
            halves = [
                ((high, value >> 16), (low, value & 0xFFFF))
                for high, low in itertools.permutations(parts, 2)
            ]
            for choice in (*whole, *halves):
                before = [(part, self.nodes.number(part)) for part, _ in choice]
                with contextlib.suppress(NodeError, OverflowError, ValueError):
                    for part, number in choice:
                        self.nodes.write(part, number)
                    if self.nodes.integer(name) == value:
                        return
                for part, old in before:
                    with contextlib.suppress(NodeError, OverflowError, ValueError):
                        self.nodes.write(part, old)

    def number_or(self, name: str, default: float) -> float:
        """The value of a feature; `default` where the camera has none."""
        with self.lock:
            try:
                return self.nodes.number(name)
            except NodeError:
                return default

    def symbolic_or(self, name: str, default: str) -> str:
        """The current entry of an enumeration; `default` where the camera has none."""
        with self.lock:
            try:
                return self.nodes.symbolic(name) or default
            except NodeError:
                return default

    def is_command_given(self, name: str, address: int) -> bool:
        """Whether a write at this address has set the command's value; it is then cleared.

        Some descriptions leave selectors to the controller, so that the place of a command is
        known only up to them; a write at any of its places counts.
        """
        with self.lock:
            if name not in self.nodes.nodes:
                return False
            for choice in self._choices.get(name, [{}]):
                for selector, value in choice.items():
                    self.nodes.set_local(selector, value)
                try:
                    register = self.register_of(self.nodes, name)
                    if self.nodes.address(register) & _ADDRESS_MASK & ~3 != address & ~3:
                        continue
                    source = self.nodes.node(name).text("pValue")
                    given = self.nodes.integer(source) == self._command_value(name)
                    if given and self.nodes.node(register).kind == "MaskedIntReg":
                        self.nodes.write(register, 0)
                except NodeError:
                    continue
                if given:
                    return True
            return False

    def is_trigger_on(self, source: str) -> bool:
        """Whether some trigger of the camera is on and waits for a source of this kind.

        Which trigger the controller has selected is not known where the selector is its own.
        """
        with self.lock:
            for choice in self._choices_of("TriggerMode") if self._has("TriggerMode") else ():
                for selector, value in choice.items():
                    self.nodes.set_local(selector, value)
                if self.symbolic_or("TriggerMode", "Off") == "On" and self.symbolic_or(
                    "TriggerSource", ""
                ).startswith(source):
                    return True
            return False

    def _has(self, name: str) -> bool:
        return name in self.nodes.nodes

    def _find_choices(self) -> dict[str, list[dict[str, int]]]:
        """Values of the controller's selectors under which each command may be given."""
        return {name: self._choices_of(name) for name in COMMANDS if name in self.nodes.nodes}

    def _choices_of(self, name: str) -> list[dict[str, int]]:
        """Values of the controller's selectors on which a node depends."""
        held = controller_selectors(self.nodes)
        waiting, visited = [name], set()
        while waiting:
            current = waiting.pop()
            if current not in visited:
                visited.add(current)
                waiting += self.nodes.references(current)
        selectors = sorted(visited & held.keys())
        choices = itertools.product(*(held[selector] for selector in selectors))
        return [
            dict(zip(selectors, choice, strict=True))
            for choice in itertools.islice(choices, _CHOICES_MAX)
        ]

    def _place_selected(self) -> set[int]:
        """Words in which a register lies under some selector that the controller holds."""
        words: set[int] = set()
        before = {name: int(self.nodes.number(name)) for name in controller_selectors(self.nodes)}
        for name in self._moving:
            choices = self._choices_of(name) if before else [{}]
            for choice in choices if choices != [{}] else ():
                for selector, value in choice.items():
                    self.nodes.set_local(selector, value)
                with contextlib.suppress(NodeError):
                    start = self.nodes.address(name) & _ADDRESS_MASK
                    words.update(range(start >> 2, (start + self.nodes.length(name) + 3) >> 2))
        for selector, value in before.items():
            self.nodes.set_local(selector, value)
        return words

    @staticmethod
    def register_of(nodes: NodeMap, name: str) -> str:
        """The register that a feature's value lies in. NodeError: there is none."""
        for _ in range(_CHAIN_MAX):
            node = nodes.node(name)
            if node.kind in REGISTERS:
                return name
            name = nodes.value_source(node)
        raise NodeError(f"{name} has no register")

    def _command_value(self, name: str) -> int:
        node = self.nodes.node(name)
        source = node.text("pCommandValue")
        return self.nodes.integer(source) if source else int(node.text("CommandValue", "1"), 0)

    # Who owns an address

    def _place_registers(self) -> tuple[dict[int, list[str]], list[str]]:
        """Registers with a fixed address by word, and those whose address depends on others."""
        fixed: dict[int, list[str]] = defaultdict(list)
        moving = []
        for name, node in self.nodes.nodes.items():
            if node.kind not in REGISTERS or self._is_in_frames(node):
                continue
            if node.texts("pAddress") or node.texts("pIndex") or node.texts("pLength"):
                moving.append(name)
                continue
            start = self.nodes.address(name) & _ADDRESS_MASK
            for word in range(start >> 2, (start + self.nodes.length(name) + 3) >> 2):
                fixed[word].append(name)
        return fixed, moving

    def _is_in_frames(self, node: Node) -> bool:
        """Whether a register lies in chunk or event data instead of the camera's memory."""
        port = self.nodes.nodes.get(node.text("pPort"))
        return port is not None and bool(port.texts("ChunkID") or port.texts("EventID"))

    def _owners(self, address: int, length: int) -> list[str]:
        """Registers of the description that lie, in this state, in these bytes.

        An empty name stands for one whose place depends on a selector that the controller holds.
        """
        words = range(address >> 2, (address + length + 3) >> 2)
        found = list(dict.fromkeys(name for word in words for name in self._fixed.get(word, ())))
        near = False
        for name in self._moving:
            try:
                start = self.nodes.address(name) & _ADDRESS_MASK
                end = start + self.nodes.length(name)
            except NodeError:
                continue
            if start < address + length and address < end:
                found.append(name)
            near = near or abs(start - address) < _SELECTED_RANGE_NBYTES
        if any(word in self._selected for word in words):
            found.append("")
        return found or [""] * near

    def _find_writers(self) -> dict[str, list[str]]:
        """Features by the register that they write."""
        found: dict[str, list[str]] = defaultdict(list)
        for feature in features_of(self.nodes):
            name, seen = feature, set()
            while name in self.nodes.nodes and name not in seen:
                seen.add(name)
                found[name].append(feature)
                node = self.nodes.nodes[name]
                for other in node.texts("pValueCopy") + [
                    item.text for item in node.properties.get("pValueIndexed", ())
                ]:
                    found[other].append(feature)
                name = node.text("pValue")
        return found

    def _check_access(self, owners: list[str], address: int, data: bytes) -> None:
        """Refuse a write of which the description allows no part."""
        changed = [name for name in owners if self._is_changed(name, address, data)]
        refused = []
        for name in changed or owners:
            if not name or self._may_write(name):
                return
            refused.append(name)
        self.refused.append(", ".join(refused))
        raise RegisterRefusedError(Status.ACCESS_DENIED)

    def _may_write(self, name: str) -> bool:
        nodes = self.nodes
        try:
            if nodes.node(name).text("AccessMode") == "RO":
                return False
            features = self._writers.get(name, [])
            return not features or any(
                nodes.node(feature).kind == "Command" or nodes.access(feature).is_writable
                for feature in features
            )
        except NodeError:
            return False

    def _is_changed(self, name: str, address: int, data: bytes) -> bool:
        if not name:
            return True
        node = self.nodes.node(name)
        start = self.nodes.address(name) & _ADDRESS_MASK
        length = self.nodes.length(name)
        if node.kind not in INTEGER_REGISTERS or not address <= start <= address + len(data):
            return True
        order: Literal["big", "little"] = "big" if is_big_endian(node) else "little"
        shift, bits = bit_field(node, length)
        mask = (1 << bits) - 1 << shift
        before = self.memory.read(start, length)
        after = bytearray(before)
        offset = start - address
        part = data[offset : offset + length]
        after[: len(part)] = part
        old = int.from_bytes(before, order)
        new = int.from_bytes(after, order)
        return (old ^ new) & mask != 0

    def _within_limits(self, owners: list[str]) -> set[str]:
        """Features written through these registers whose value is allowed."""
        found = set()
        for owner in owners:
            for feature in self._writers.get(owner, []):
                if self.nodes.node(feature).kind in _BOUNDED and self._is_allowed(feature):
                    found.add(feature)
        return found

    def _is_allowed(self, feature: str) -> bool:
        nodes = self.nodes
        try:
            node = nodes.node(feature)
            if node.kind == "Enumeration":
                value = nodes.integer(feature)
                return any(
                    nodes.entry_value(entry) == value and nodes.is_implemented(entry)
                    for entry in node.entries
                )
            if not _is_in_set(node, nodes.number(feature)):
                return False
            limits = nodes.limits(feature)
            slack = _TOLERANCE * max(abs(limits.minimum), abs(limits.maximum))
            if node.kind == "Integer":
                slack = 0.0
            return limits.minimum - slack <= nodes.number(feature) <= limits.maximum + slack
        except NodeError:
            return False

    def _url(self) -> str:
        description = self._description
        return f"Local:{description.file_name};{XML_START:X};{len(description.stored):X}"

    def _write_bootstrap(self) -> None:
        """The bootstrap registers. Source: GigE Vision 2.0, section 28."""
        identity, memory = self._identity, self.memory
        ip = int(ipaddress.IPv4Address(identity.address))
        for address, value in (
            (at.VERSION, 0x0002_0000),
            (at.DEVICE_MODE, 0x8000_0001),
            (at.MAC_HIGH, 0x0200),
            (at.MAC_LOW, ip),
            (at.IP_OPTIONS, 7),
            (at.IP_CONFIGURATION, 7),
            (at.IP_ADDRESS, ip),
            (at.SUBNET_MASK, 0xFF00_0000),
            (at.INTERFACES, 1),
            (at.STREAM_CHANNELS, 1),
            (at.ACTION_SIGNALS, 1),
            (at.CONTROL_CAPABILITY, 0xC000_0007),
            (at.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS),
            (at.STREAM_PACKET_SIZE, 1500),
            (at.CONTROL_PRIVILEGE, 0),
            (at.STREAM_PORT, 0),
        ):
            memory.write(address, struct.pack(">I", value))
        memory.write(at.TICK_FREQUENCY_HIGH, struct.pack(">Q", TICK_FREQUENCY_HZ))
        for address, text, length in (
            (at.MANUFACTURER, identity.vendor, 32),
            (at.MODEL, identity.model, 32),
            (at.DEVICE_VERSION, "1.0", 32),
            (at.MANUFACTURER_INFO, "emulated", 48),
            (at.SERIAL, identity.serial, 16),
            (at.USER_NAME, identity.user_id, 16),
            (at.XML_URL, self._url(), 512),
        ):
            memory.write(address, text.encode("utf-8")[: length - 1].ljust(length, b"\0"))


def _is_in_set(node: Node, value: float) -> bool:
    """Whether a value is one of those that the description lists, if it lists any."""
    listed = node.text("ValidValueSet")
    return not listed or value in {int(item, 0) for item in listed.split(";") if item.strip()}
