"""Features of a GenICam description that refer to themselves.

The standard forbids them. Aravis follows the references without end, which ends the process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final
from xml.etree import ElementTree

from drivers import DriverError

VALUE: Final = "value"
VALUE_TAGS: Final = ("pValue", "pVariable", "pAddress", "pIndex", "pLength")
CONDITION_TAGS: Final = ("pIsLocked", "pIsAvailable", "pIsImplemented")
LIMIT_TAGS: Final = ("pMin", "pMax", "pInc")
LIMIT_SUFFIXES: Final = {"Min": "pMin", "Max": "pMax", "Inc": "pInc"}

Aspect = tuple[str, str]
"""A node, and what of it is evaluated: its value, a limit or a condition."""


class DescriptionUnreadableError(DriverError):
    """A description that is no XML; the message is the reason."""


def features_with_cycles(xml: bytes) -> frozenset[str]:
    """Find the features whose evaluation would not end.

    Args:
        xml: the description as the head stores it.

    Returns:
        Names of nodes of which the value, a limit or a condition depends on itself.

    Raises:
        DescriptionUnreadableError: it is no XML, or has no nodes.

    Example:
        >>> features_with_cycles(
        ...     b'<R><Integer Name="A"><pIsLocked>B</pIsLocked></Integer>'
        ...     b'<IntSwissKnife Name="B"><pVariable Name="X">B</pVariable></IntSwissKnife></R>'
        ... ) == {"A", "B"}
        True
    """
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise DescriptionUnreadableError(str(error)) from None
    graph = _references(root)
    if not graph:
        raise DescriptionUnreadableError("it has no nodes")
    endless = _reaching_a_cycle(graph)
    return frozenset(name for name, _ in endless)


def _references(root: ElementTree.Element) -> dict[Aspect, list[Aspect]]:
    """What is evaluated for what."""
    graph: dict[Aspect, list[Aspect]] = {}
    for node in root.iter():
        name = node.get("Name")
        if name is None or _tag(node) in ("EnumEntry", "StructEntry", "pVariable", "Constant"):
            continue
        for child in node:
            for aspect, target in _references_of(child, _tag(child)):
                graph.setdefault((name, aspect), []).append(target)
        graph.setdefault((name, VALUE), [])
    return graph


def _references_of(child: ElementTree.Element, tag: str) -> Iterator[tuple[str, Aspect]]:
    target = (child.text or "").strip()
    if tag == "pVariable":
        # A variable may be a limit of a node instead of its value: NAME.Max.
        suffix = child.get("Name", "").rpartition(".")[2]
        yield VALUE, (target, LIMIT_SUFFIXES.get(suffix, VALUE))
    elif tag in VALUE_TAGS:
        yield VALUE, (target, VALUE)
        if tag == "pValue":
            for aspect in (*CONDITION_TAGS, *LIMIT_TAGS):
                yield aspect, (target, aspect)
    elif tag in CONDITION_TAGS or tag in LIMIT_TAGS:
        yield tag, (target, VALUE)
    elif tag == "EnumEntry":
        for condition in child:
            if _tag(condition) in CONDITION_TAGS:
                yield "pIsAvailable", ((condition.text or "").strip(), VALUE)


def _reaching_a_cycle(graph: Mapping[Aspect, list[Aspect]]) -> set[Aspect]:
    """Aspects from which a cycle is reached: those that remain when the ends are removed."""
    callers: dict[Aspect, list[Aspect]] = {}
    open_count: dict[Aspect, int] = {}
    for aspect, targets in graph.items():
        known = [target for target in targets if target in graph]
        open_count[aspect] = len(known)
        for target in known:
            callers.setdefault(target, []).append(aspect)
    ended = [aspect for aspect, count in open_count.items() if count == 0]
    while ended:
        for caller in callers.get(ended.pop(), ()):
            open_count[caller] -= 1
            if open_count[caller] == 0:
                ended.append(caller)
    return {aspect for aspect, count in open_count.items() if count}


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]
