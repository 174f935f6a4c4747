"""Values, limits and access modes of the nodes of a description, over the registers of a camera.

Source: GenICam Standard 2.1.1, sections 2.2 to 2.8.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, Protocol

from sim_hw import SimulatorError
from sim_hw.gige.genicam.description_file import Description, Node
from sim_hw.gige.genicam.formula import Evaluate, FormulaError, Number, compile_formula

INTEGER_REGISTERS = frozenset({"IntReg", "MaskedIntReg"})
REGISTERS = INTEGER_REGISTERS | {"FloatReg", "StringReg", "Register"}
FORMULAS = frozenset({"SwissKnife", "IntSwissKnife"})
CONVERTERS = frozenset({"Converter", "IntConverter"})
_DEPTH_MAX = 100
_FLOAT_FORMATS = {4: "f", 8: "d"}


class NodeError(SimulatorError, ValueError):
    """A node that does not exist or has no value in this state."""


class Access(IntEnum):
    """Access mode of a node, from the least to the most."""

    NOT_IMPLEMENTED = 0
    NOT_AVAILABLE = 1
    WRITE_ONLY = 2
    READ_ONLY = 3
    READ_WRITE = 4

    @property
    def is_readable(self) -> bool:
        return self in (Access.READ_ONLY, Access.READ_WRITE)

    @property
    def is_writable(self) -> bool:
        return self in (Access.WRITE_ONLY, Access.READ_WRITE)


_ACCESS = {"RO": Access.READ_ONLY, "WO": Access.WRITE_ONLY, "RW": Access.READ_WRITE}


class Port(Protocol):
    """The registers of the camera."""

    def read(self, address: int, length: int) -> bytes: ...

    def write(self, address: int, data: bytes) -> None: ...


@dataclass(frozen=True)
class Limits:
    """Lowest and highest value of a node, and its increment."""

    minimum: Number
    maximum: Number
    increment: Number


class NodeMap:
    """The nodes of one description over the registers of one camera.

    Values are remembered until `invalidate`. Nodes with a constant `Value` that may be written,
    such as `TLParamsLocked`, hold it here.

    Args:
        description: the camera's description.
        port: the camera's registers.
    """

    def __init__(self, description: Description, port: Port) -> None:
        self.nodes = description.nodes
        self._port = port
        self._local: dict[str, Number] = {}
        self._formulas: dict[tuple[str, str], Evaluate] = {}
        self._values: dict[str, Number | str | bytes] = {}
        self._accesses: dict[str, Access] = {}
        self._addresses: dict[str, int] = {}
        self._depth = 0

    def invalidate(self) -> None:
        """Forget remembered values, after registers have changed."""
        self._values.clear()
        self._accesses.clear()
        self._addresses.clear()

    def node(self, name: str) -> Node:
        """The node of this name. NodeError: there is none."""
        try:
            return self.nodes[name]
        except KeyError:
            raise NodeError(f"there is no node {name}") from None

    # Values

    def value(self, name: str) -> Number | str | bytes:
        """The value of a node in its own unit; an enumeration's is its integer.

        Raises:
            NodeError: it does not exist, or has no value in this state.
        """
        found = self._values.get(name)
        if found is None:
            with _Nesting(self, name):
                found = self._value(self.node(name))
            self._values[name] = found
        return found

    def number(self, name: str) -> Number:
        """The value of a node that is a number. NodeError: it is none."""
        found = self.value(name)
        if not isinstance(found, int | float):
            raise NodeError(f"{name} is no number")
        return found

    def integer(self, name: str) -> int:
        """The value of a node as an integer."""
        return int(self.number(name))

    def set_local(self, name: str, value: Number) -> None:
        """Set a node that has a `Value` of its own instead of a register."""
        self._local[name] = value
        self.invalidate()

    def symbolic(self, name: str) -> str | None:
        """The name of an enumeration's current entry; None if its value is no entry."""
        value = self.integer(name)
        for entry in self.node(name).entries:
            if self.entry_value(entry) == value:
                return entry.name
        return None

    def entry_value(self, entry: Node) -> int:
        """The integer of an enumeration's entry."""
        return int(_parse_number(entry.text("Value", "0")))

    def _value(self, node: Node) -> Number | str | bytes:
        if node.kind in REGISTERS:
            return self._register_value(node)
        if node.kind in FORMULAS:
            return self._evaluate(node, "Formula", {})
        if node.kind in CONVERTERS:
            inner = self.number(node.text("pValue"))
            return self._evaluate(node, "FormulaFrom", {"TO": inner})
        source = self.value_source(node)
        if source:
            found = self.value(source)
            if node.kind == "Boolean":
                return int(found == self._on_value(node))
            return found
        if node.name in self._local:
            return self._local[node.name]
        text = self._constant(node)
        return text if node.kind == "String" else _parse_number(text or "0")

    def value_source(self, node: Node) -> str:
        """The node that a node takes its value from; empty for a constant."""
        indexed = node.properties.get("pValueIndexed", ())
        if indexed or node.text("pValueDefault"):
            index = self.integer(node.text("pIndex"))
            for item in indexed:
                if int(_parse_number(item.attributes.get("Index", "0"))) == index:
                    return item.text
            return node.text("pValueDefault")
        return node.text("pValue")

    def _constant(self, node: Node) -> str:
        indexed = node.properties.get("ValueIndexed", ())
        if indexed:
            index = self.integer(node.text("pIndex"))
            for item in indexed:
                if int(_parse_number(item.attributes.get("Index", "0"))) == index:
                    return item.text
            return node.text("ValueDefault")
        return node.text("Value") or node.text("CommandValue")

    def _on_value(self, node: Node) -> int:
        return int(_parse_number(node.text("OnValue", "1")))

    def _register_value(self, node: Node) -> Number | str | bytes:
        data = self._port.read(self.address(node.name), self.length(node.name))
        if node.kind == "StringReg":
            return data.split(b"\0")[0].decode("utf-8", "replace")
        if node.kind == "Register":
            return data
        if node.kind == "FloatReg":
            order = "<>"[is_big_endian(node)]
            try:
                (number,) = struct.unpack(order + _FLOAT_FORMATS[len(data)], data)
            except KeyError:
                raise NodeError(f"{node.name}: a float has 4 or 8 bytes") from None
            return float(number)
        raw = int.from_bytes(data, "big" if is_big_endian(node) else "little")
        shift, bits = bit_field(node, len(data))
        raw = raw >> shift & (1 << bits) - 1
        if node.text("Sign") == "Signed" and raw >> bits - 1:
            raw -= 1 << bits
        return raw

    def _evaluate(self, node: Node, tag: str, known: dict[str, Number]) -> Number:
        variables = dict(known)
        for item in node.properties.get("pVariable", ()):
            name = item.attributes.get("Name", "")
            if name not in variables:
                variables[name] = self._variable(name, item.text)
        for item in node.properties.get("Constant", ()):
            variables[item.attributes.get("Name", "")] = _parse_number(item.text)
        is_integer = node.kind.startswith("Int")
        for item in node.properties.get("Expression", ()):
            expression = self._compiled(node, item.text, is_integer)
            variables[item.attributes.get("Name", "")] = expression(variables)
        try:
            return self._compiled(node, node.text(tag), is_integer)(variables)
        except FormulaError as error:
            raise NodeError(f"{node.name}: {error}") from None

    def _compiled(self, node: Node, text: str, is_integer: bool) -> Evaluate:
        key = (node.kind, text)
        if key not in self._formulas:
            try:
                self._formulas[key] = compile_formula(text, is_integer=is_integer)
            except FormulaError as error:
                raise NodeError(f"{node.name}: {error}") from None
        return self._formulas[key]

    def _variable(self, name: str, source: str) -> Number:
        suffix = name.partition(".")[2]
        if suffix == "Min":
            return self.limits(source).minimum
        if suffix == "Max":
            return self.limits(source).maximum
        if suffix == "Inc":
            return self.limits(source).increment
        if suffix.startswith("Entry."):
            wanted = suffix.removeprefix("Entry.")
            for entry in self.node(source).entries:
                if entry.name == wanted:
                    return self.entry_value(entry)
            raise NodeError(f"{source} has no entry {wanted}")
        return self.number(source)

    # Registers

    def address(self, name: str) -> int:
        """The address of a register in this state."""
        if name in self._addresses:
            return self._addresses[name]
        node = self.node(name)
        total = sum(int(_parse_number(text)) for text in node.texts("Address"))
        total += sum(self.integer(source) for source in node.texts("pAddress"))
        for index in node.properties.get("pIndex", ()):
            step = index.attributes.get("Offset")
            if step is not None:
                offset = int(_parse_number(step))
            elif "pOffset" in index.attributes:
                offset = self.integer(index.attributes["pOffset"])
            else:
                offset = self.length(name)
            total += self.integer(index.text) * offset
        self._addresses[name] = total
        return total

    def length(self, name: str) -> int:
        """The length of a register in bytes."""
        node = self.node(name)
        source = node.text("pLength")
        found = self.integer(source) if source else int(_parse_number(node.text("Length", "4")))
        if not 0 < found <= 1 << 16:
            raise NodeError(f"{name}: a register of {found} bytes")
        return found

    def write(self, name: str, value: Number | str) -> None:
        """Write a node through to its register, whatever its access mode is.

        Raises:
            NodeError: no register stands behind it, or the value does not fit.
        """
        with _Nesting(self, name):
            self._write(self.node(name), value)
        self.invalidate()

    def _write(self, node: Node, value: Number | str) -> None:
        if node.kind in REGISTERS:
            self._write_register(node, value)
            return
        if isinstance(value, str):
            raise NodeError(f"{node.name} takes no text")
        source = self.value_source(node)
        if node.kind in CONVERTERS:
            inner = self._evaluate(node, "FormulaTo", {"FROM": value})
            self.write(source, inner)
        elif node.kind == "Boolean" and source:
            off = int(_parse_number(node.text("OffValue", "0")))
            self.write(source, self._on_value(node) if value else off)
        elif source:
            self.write(source, value)
        elif node.kind in FORMULAS:
            raise NodeError(f"{node.name} is a formula")
        else:
            raise NodeError(f"{node.name} is a constant")

    def _write_register(self, node: Node, value: Number | str) -> None:
        address, length = self.address(node.name), self.length(node.name)
        order: Literal["big", "little"] = "big" if is_big_endian(node) else "little"
        if isinstance(value, str):
            data = value.encode("utf-8")[: length - 1].ljust(length, b"\0")
        elif node.kind == "FloatReg":
            data = struct.pack("<>"[order == "big"] + _FLOAT_FORMATS[length], value)
        elif node.kind in INTEGER_REGISTERS:
            shift, bits = bit_field(node, length)
            mask = (1 << bits) - 1 << shift
            old = int.from_bytes(self._port.read(address, length), order)
            new = old & ~mask | int(value) << shift & mask
            data = new.to_bytes(length, order)
        else:
            raise NodeError(f"{node.name} takes no number")
        self._port.write(address, data)

    # Limits and access

    def limits(self, name: str) -> Limits:
        """The limits of a node in its own unit; of a register, what its bits can hold."""
        node = self.node(name)
        with _Nesting(self, name):
            lowest, highest = self._natural_limits(node)
            found: dict[str, Number] = {"Min": lowest, "Max": highest, "Inc": 1}
            for tag in found:
                if node.text(f"p{tag}"):
                    found[tag] = self.number(node.text(f"p{tag}"))
                elif node.text(tag):
                    found[tag] = _parse_number(node.text(tag))
        return Limits(found["Min"], found["Max"], found["Inc"])

    def _natural_limits(self, node: Node) -> tuple[Number, Number]:
        if node.kind in INTEGER_REGISTERS:
            _, bits = bit_field(node, self.length(node.name))
            if node.text("Sign") == "Signed":
                return -(1 << bits - 1), (1 << bits - 1) - 1
            return 0, (1 << bits) - 1
        if node.kind in CONVERTERS:
            inner = self.limits(node.text("pValue"))
            try:
                ends = [
                    self._evaluate(node, "FormulaFrom", {"TO": end})
                    for end in (inner.minimum, inner.maximum)
                ]
            except NodeError:
                return -(2**63), 2**63 - 1
            return min(ends), max(ends)
        source = self.value_source(node)
        if source:
            found = self.limits(source)
            return found.minimum, found.maximum
        return -(2**63), 2**63 - 1

    def access(self, name: str) -> Access:
        """The access mode of a node in this state, locks included."""
        found = self._accesses.get(name)
        if found is None:
            with _Nesting(self, name):
                found = self._access(self.node(name))
            self._accesses[name] = found
        return found

    def is_locked(self, name: str) -> bool:
        """Whether the node itself is locked."""
        return any(self.number(source) for source in self.node(name).texts("pIsLocked"))

    def is_implemented(self, node: Node) -> bool:
        """Whether an enumeration's entry, or a node by its own, is implemented and available."""
        sources = [*node.texts("pIsImplemented"), *node.texts("pIsAvailable")]
        return all(self._is_true(source) for source in sources)

    def _is_true(self, source: str) -> bool:
        try:
            return bool(self.number(source))
        except NodeError:
            return False

    def _access(self, node: Node) -> Access:
        if not all(self._is_true(source) for source in node.texts("pIsImplemented")):
            return Access.NOT_IMPLEMENTED
        if not all(self._is_true(source) for source in node.texts("pIsAvailable")):
            return Access.NOT_AVAILABLE
        own = _ACCESS.get(node.text("AccessMode"), Access.READ_WRITE)
        if node.kind in FORMULAS:
            own = Access.READ_ONLY
        if node.entries and not any(self.is_implemented(entry) for entry in node.entries):
            return Access.NOT_IMPLEMENTED
        if node.kind in REGISTERS:
            port = self.nodes.get(node.text("pPort"))
            if port is not None and port.texts("EventID"):
                return Access.NOT_IMPLEMENTED
            if port is not None and port.texts("ChunkID"):
                return Access.NOT_AVAILABLE
        for tag in ("pVariable", "pAddress", "pIndex"):
            for required in node.texts(tag):
                if required in self.nodes and not self.access(required).is_readable:
                    return min(self.access(required), Access.NOT_AVAILABLE)
        own = _both(own, _ACCESS.get(node.text("ImposedAccessMode"), Access.READ_WRITE))
        source = self.value_source(node)
        if source:
            own = _both(own, self.access(source))
        if own.is_writable and self.is_locked(node.name):
            own = _both(own, Access.READ_ONLY)
        return own

    def references(self, name: str) -> Iterator[str]:
        """Names of the nodes on which a node's value, limits and address depend."""
        node = self.node(name)
        for tag, found in node.properties.items():
            if tag[:1] == "p" and tag[1:2].isupper() and tag not in _NO_VALUES:
                for item in found:
                    if item.text in self.nodes:
                        yield item.text
                    offset = item.attributes.get("pOffset")
                    if offset in self.nodes:
                        yield str(offset)


_NO_VALUES = frozenset(
    {"pFeature", "pInvalidator", "pSelected", "pPort", "pAlias", "pCastAlias", "pError"}
    | {"pIsImplemented", "pIsAvailable", "pIsLocked"}
)


class _Nesting:
    """Refuses nodes that refer to themselves."""

    def __init__(self, nodes: NodeMap, name: str) -> None:
        self._nodes, self._name = nodes, name

    def __enter__(self) -> None:
        self._nodes._depth += 1
        if self._nodes._depth > _DEPTH_MAX:
            self._nodes._depth -= 1
            raise NodeError(f"{self._name} refers to itself")

    def __exit__(self, *_: object) -> None:
        self._nodes._depth -= 1


def is_big_endian(node: Node) -> bool:
    """Whether a register is big-endian; the standard's default is little-endian."""
    return node.text("Endianess") == "BigEndian"


def bit_field(node: Node, nbytes: int) -> tuple[int, int]:
    """The shift and width in bits of an integer register.

    Bits of a big-endian register are counted from the most significant one.
    """
    if node.kind == "IntReg":
        return 0, 8 * nbytes
    first = int(_parse_number(node.text("LSB") or node.text("Bit", "0")))
    last = int(_parse_number(node.text("MSB") or node.text("Bit", "0")))
    low, high = min(first, last), max(first, last)
    shift = 8 * nbytes - 1 - high if is_big_endian(node) else low
    if shift < 0 or high >= 8 * nbytes:
        raise NodeError(f"{node.name}: bit {high} of {8 * nbytes}")
    return shift, high - low + 1


def _both(first: Access, second: Access) -> Access:
    """The access that two modes allow together."""
    if Access.NOT_IMPLEMENTED in (first, second):
        return Access.NOT_IMPLEMENTED
    readable = first.is_readable and second.is_readable
    writable = first.is_writable and second.is_writable
    if readable:
        return Access.READ_WRITE if writable else Access.READ_ONLY
    return Access.WRITE_ONLY if writable else Access.NOT_AVAILABLE


def _parse_number(text: str) -> Number:
    text = text.strip()
    try:
        return int(text, 0)
    except ValueError:
        pass
    try:
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError:
        raise NodeError(f"{text!r} is no number") from None
