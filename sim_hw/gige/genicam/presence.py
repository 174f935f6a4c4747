"""What a camera states of itself: which features it has, and where their registers lie.

Registers that only state this are filled here; `power_on_state` writes the values of features.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

from sim_hw.gige.genicam.description_file import Node
from sim_hw.gige.genicam.formula import Number
from sim_hw.gige.genicam.node_map import INTEGER_REGISTERS, REGISTERS, NodeError, NodeMap

_FIRST_BASE, _BASE_STEP = 0x4_0000, 0x400
_TRIALS_MAX = 60


def write_bases(nodes: NodeMap) -> None:
    """Give each group of registers whose address is read from the camera a place of its own."""
    bases: dict[str, None] = {}
    for node in nodes.nodes.values():
        if node.kind in REGISTERS:
            for source in node.texts("pAddress"):
                if source in nodes.nodes:
                    bases |= dict.fromkeys(sorted(leaves_of(nodes, source)))
    place = _FIRST_BASE
    for leaf in bases:
        if _is_read_only(nodes, leaf) and not number_or(nodes, leaf, 0):
            try_write(nodes, leaf, place)
            place += _BASE_STEP


def write_presence(nodes: NodeMap, features: Iterable[str], held: Collection[str]) -> None:
    """Let as many of these features as possible be implemented and available.

    Registers in `held` are values of features.
    """
    conditions = {source for name in features for source in _conditions(nodes, name)}
    bits = [
        leaf
        for leaf in {leaf for condition in conditions for leaf in leaves_of(nodes, condition)}
        if _is_inquiry(nodes, leaf, held)
    ]
    for leaf in sorted(bits):
        if not number_or(nodes, leaf, 0):
            try_write(nodes, leaf, 1)
    for condition in sorted(conditions):
        if not number_or(nodes, condition, 0):
            _search_true(nodes, condition, held)


def unlock(nodes: NodeMap, features: Iterable[str]) -> None:
    """Let the camera report a state of rest, such as a stopped acquisition."""
    locks = {
        source
        for name in features
        for node in value_chain(nodes, name)
        for source in nodes.nodes[node].texts("pIsLocked")
    }
    for lock in sorted(locks):
        for leaf in sorted(leaves_of(nodes, lock)) if number_or(nodes, lock, 0) else ():
            before = number_or(nodes, leaf, 0)
            if not _is_read_only(nodes, leaf) or before:
                continue
            if try_write(nodes, leaf, 1) and not number_or(nodes, lock, 1):
                break
            try_write(nodes, leaf, before)


def write_selected_presence(
    nodes: NodeMap, selector: str, selected: Collection[str], held: Collection[str]
) -> None:
    """Let features be present for every entry of their selector; each may be stated by itself."""
    if selector not in nodes.nodes or not selected:
        return
    before = number_or(nodes, selector, 0)
    last = list(value_chain(nodes, selector))[-1]
    for value in (*(nodes.entry_value(e) for e in nodes.nodes[selector].entries), before):
        if nodes.nodes[last].texts("Value"):
            nodes.set_local(last, value)
        elif not try_write(nodes, selector, value):
            continue
        write_presence(nodes, selected, held)


def _conditions(nodes: NodeMap, name: str) -> Iterator[str]:
    """Nodes that decide whether a feature, what it stands for or one of its entries exists."""
    visited: set[str] = set()
    while name and name not in visited and name in nodes.nodes:
        visited.add(name)
        node = nodes.nodes[name]
        limits = [nodes.nodes[limit] for limit in _limit_nodes(node) if limit in nodes.nodes]
        for part in (node, *node.entries, *limits):
            yield from part.texts("pIsImplemented")
            yield from part.texts("pIsAvailable")
        name = node.text("pValue")


def _limit_nodes(node: Node) -> Iterator[str]:
    for tag in ("pMin", "pMax", "pInc"):
        yield from node.texts(tag)


def leaves_of(nodes: NodeMap, name: str) -> set[str]:
    """Registers on which the value of a node depends."""
    found, waiting, visited = set(), [name], set()
    while waiting:
        current = waiting.pop()
        if current in visited or current not in nodes.nodes:
            continue
        visited.add(current)
        if nodes.nodes[current].kind in REGISTERS:
            found.add(current)
        else:
            waiting += nodes.references(current)
    return found


def _is_inquiry(nodes: NodeMap, leaf: str, held: Collection[str]) -> bool:
    """Whether a register only states what the camera has.

    These are read-only integers. Some makers declare them writable; no feature stands for those.
    """
    is_integer = nodes.nodes[leaf].kind in INTEGER_REGISTERS
    return _is_read_only(nodes, leaf) or (is_integer and leaf not in held)


def _is_read_only(nodes: NodeMap, leaf: str) -> bool:
    node = nodes.nodes[leaf]
    return node.kind in INTEGER_REGISTERS and node.text("AccessMode") == "RO"


def _search_true(nodes: NodeMap, condition: str, held: Collection[str]) -> None:
    """Try values of the inquiry registers behind a condition until it is true."""
    trials = 0
    for leaf in sorted(leaves_of(nodes, condition)):
        if not _is_inquiry(nodes, leaf, held):
            continue
        before = number_or(nodes, leaf, 0)
        for value in _candidates(nodes, leaf):
            trials += 1
            if trials > _TRIALS_MAX:
                return
            if try_write(nodes, leaf, value) and number_or(nodes, condition, 0):
                return
        try_write(nodes, leaf, before)


def _candidates(nodes: NodeMap, leaf: str) -> list[int]:
    limits = nodes.limits(leaf)
    bits = max(1, int(limits.maximum).bit_length())
    return [int(limits.maximum), 0, *(1 << bit for bit in range(min(bits, 32)))]


def value_chain(nodes: NodeMap, name: str) -> Iterator[str]:
    visited: set[str] = set()
    while name and name not in visited and name in nodes.nodes:
        visited.add(name)
        yield name
        name = nodes.nodes[name].text("pValue")


def try_write(nodes: NodeMap, name: str, value: Number) -> bool:
    if name not in nodes.nodes:
        return False
    try:
        nodes.write(name, value)
    except (NodeError, OverflowError, ValueError, KeyError, ArithmeticError):
        return False
    return True


def number_or(nodes: NodeMap, name: str, default: Number) -> Number:
    try:
        return nodes.number(name)
    except NodeError:
        return default
