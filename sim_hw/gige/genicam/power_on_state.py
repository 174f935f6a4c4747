"""Registers of a camera after power-on, made from its description alone.

A description states which registers a camera has and what they mean, not what they hold. This
module chooses values under which the features of the description are implemented and available,
their limits are in order, and every enumeration has a valid entry.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from enum import Enum

from sim_hw.gige.genicam.description_file import Node
from sim_hw.gige.genicam.formula import Number
from sim_hw.gige.genicam.node_map import INTEGER_REGISTERS, REGISTERS, NodeError, NodeMap

VALUED = frozenset(
    {"Integer", "Float", "Enumeration", "Boolean", "Command", "String"}
    | {"Converter", "IntConverter"}
    | REGISTERS
)


class InitialState(Enum):
    """What a camera may hold when it is opened."""

    FACTORY = "factory"
    AUTOMATIC = "automatic"
    """Automatic functions on, as many cameras leave the factory or a viewer."""
    USER_SET = "user-set"
    """Another program has saved its own values: binning, offsets, a test pattern, a trigger."""


SENSOR_WIDTH_PX, SENSOR_HEIGHT_PX = 640, 480
_SIZES: Mapping[str, int] = {
    **dict.fromkeys(("Width", "WidthMax", "SensorWidth"), SENSOR_WIDTH_PX),
    **dict.fromkeys(("Height", "HeightMax", "SensorHeight"), SENSOR_HEIGHT_PX),
}
_UPPER_LIMITS: Mapping[str, float] = {
    "ExposureTimeBaseAbs": 20.0,
    "ExposureTime": 1e6,
    "ExposureTimeAbs": 1e6,
    "ExposureTimeRaw": 1e6,
    "Gain": 24.0,
    "GainRaw": 240,
    "Gamma": 4.0,
    "DeviceTemperature": 100.0,
}
_LOWER_LIMITS: Mapping[str, float] = {
    "ExposureTime": 20.0,
    "ExposureTimeAbs": 20.0,
    "ExposureTimeRaw": 20,
}
_UPPER_LIMIT = 4096
_FACTORY_VALUES: Mapping[str, float] = {
    "ExposureTime": 5000.0,
    "ExposureTimeAbs": 5000.0,
    "ExposureTimeRaw": 5000,
    "ExposureTimeBaseAbs": 1.0,
    "AcquisitionFrameRate": 10.0,
    "AcquisitionFrameRateAbs": 10.0,
    "DeviceTemperature": 41.5,
    "TemperatureAbs": 41.5,
    "BinningHorizontal": 1,
    "BinningVertical": 1,
    "DecimationHorizontal": 1,
    "DecimationVertical": 1,
    "Gamma": 1.0,
}
_FACTORY_ENTRIES: Mapping[str, tuple[str, ...]] = {
    "AcquisitionMode": ("Continuous",),
    "ExposureMode": ("Timed",),
    "PixelFormat": ("Mono8", "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8"),
    "TriggerMode": ("Off",),
    "ExposureAuto": ("Off",),
    "GainAuto": ("Off",),
    "BalanceWhiteAuto": ("Off",),
    "BlackLevelAuto": ("Off",),
    "TestPattern": ("Off",),
    "TestImageSelector": ("Off",),
    "ChunkSelector": ("Image",),
}
_AUTOMATIC_ENTRIES = ("Continuous",)
_AUTOMATIC_SWITCHES = (
    *("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled", "GammaEnable", "GammaEnabled"),
    *("SharpnessEnabled", "SharpeningEnable", "LUTEnable", "DefectCorrectionEnable"),
    "DefectCorrectStaticEnable",
)
_USER_VALUES: Mapping[str, float] = {
    "BinningHorizontal": 2,
    "BinningVertical": 2,
    "DecimationHorizontal": 2,
    "DecimationVertical": 2,
    "ReverseX": 1,
    "ReverseY": 1,
    "ChunkModeActive": 1,
    "ExposureTime": 123_456.0,
    "ExposureTimeAbs": 123_456.0,
    "Gain": 11.0,
    "GainRaw": 100,
    "Width": 320,
    "Height": 240,
    "OffsetX": 32,
    "OffsetY": 16,
}
_USER_ENTRIES: Mapping[str, tuple[str, ...]] = {
    "AcquisitionMode": ("SingleFrame", "MultiFrame"),
    "ExposureMode": ("TriggerWidth", "TriggerControlled"),
    "TriggerMode": ("On",),
    "TriggerSource": ("Line2", "Line1", "Line0", "Freerun"),
    "TriggerSelector": ("AcquisitionStart", "FrameBurstStart"),
    "TestPattern": ("GreyHorizontalRamp", "HorizontalRamp", "Increasing"),
    "TestImageSelector": ("GreyHorizontalRamp", "Testimage1", "TestImage1", "TestPattern1"),
}
_FIRST_BASE, _BASE_STEP = 0x4_0000, 0x400
_RANGE_MIN = 10
_TRIALS_MAX = 60


def features_of(nodes: NodeMap) -> list[str]:
    """Names of the features that the categories list, each once, in their order."""
    found: dict[str, None] = {}
    waiting = ["Root"] if "Root" in nodes.nodes else _categories(nodes)
    visited = set()
    while waiting:
        name = waiting.pop(0)
        node = nodes.nodes.get(name)
        if node is None or name in visited:
            continue
        visited.add(name)
        if node.kind == "Category":
            waiting += node.texts("pFeature")
        else:
            found[name] = None
    return list(found)


def _categories(nodes: NodeMap) -> list[str]:
    """All categories, for a description without a root."""
    return [name for name, node in nodes.nodes.items() if node.kind == "Category"]


def controller_selectors(nodes: NodeMap) -> dict[str, list[int]]:
    """Constants that stand for a selector or mode, which the controller sets for itself.

    Returns:
        Their values by node, that of a trigger for single frames first.
    """
    found: dict[str, list[int]] = {}
    for name in features_of(nodes):
        node = nodes.nodes[name]
        last = name
        while node.kind == "Enumeration" and nodes.nodes[last].text("pValue") in nodes.nodes:
            last = nodes.nodes[last].text("pValue")
        if node.kind == "Enumeration" and nodes.nodes[last].texts("Value"):
            entries = sorted(node.entries, key=lambda entry: entry.name != "FrameStart")
            found[last] = [nodes.entry_value(entry) for entry in entries]
    return {selector: values for selector, values in found.items() if values}


def write_power_on_state(nodes: NodeMap, state: InitialState = InitialState.FACTORY) -> None:
    """Write registers such that the camera's features are usable.

    Args:
        nodes: the nodes over empty registers.
        state: what the camera holds when it is opened.
    """
    features = [name for name in features_of(nodes) if nodes.nodes[name].kind in VALUED]
    for selector, values in controller_selectors(nodes).items():
        nodes.set_local(selector, values[0])
    _write_bases(nodes)
    _write_presence(nodes, features)
    held = {register for name in features for register in _value_chain(nodes, name)}
    known = [name for name in (*_SIZES, *_UPPER_LIMITS) if name in nodes.nodes]
    for name in dict.fromkeys((*known, *features)):
        if _is_number(nodes.nodes[name]):
            _order_limits(nodes, name, held)
            _write_factory_value(nodes, name)
    for name in features:
        _write_factory_value(nodes, name)
    # Conditions may depend on values that have just been written.
    _write_presence(nodes, features)
    _write_chunk_presence(nodes)
    if state is InitialState.AUTOMATIC:
        _write_automatic(nodes, features)
    elif state is InitialState.USER_SET:
        for name, value in _USER_VALUES.items():
            if _is_writable(nodes, name):
                _try_write(nodes, name, value)
        for name, entries in _USER_ENTRIES.items():
            if _is_writable(nodes, name):
                _choose_entry(nodes, name, entries)


def _write_bases(nodes: NodeMap) -> None:
    """Give each group of registers whose address is read from the camera a place of its own."""
    bases: dict[str, None] = {}
    for node in nodes.nodes.values():
        if node.kind in REGISTERS:
            for source in node.texts("pAddress"):
                if source in nodes.nodes:
                    bases |= dict.fromkeys(sorted(_leaves(nodes, source)))
    place = _FIRST_BASE
    for leaf in bases:
        if _is_inquiry(nodes, leaf) and not _number_or(nodes, leaf, 0):
            _try_write(nodes, leaf, place)
            place += _BASE_STEP


def _write_presence(nodes: NodeMap, features: Iterable[str]) -> None:
    """Let as many features as possible be implemented and available."""
    conditions = {source for name in features for source in _conditions(nodes, name)}
    bits = [
        leaf
        for leaf in {leaf for condition in conditions for leaf in _leaves(nodes, condition)}
        if _is_inquiry(nodes, leaf)
    ]
    for leaf in sorted(bits):
        if not _number_or(nodes, leaf, 0):
            _try_write(nodes, leaf, 1)
    for condition in sorted(conditions):
        if not _number_or(nodes, condition, 0):
            _search_true(nodes, condition)


def _write_chunk_presence(nodes: NodeMap) -> None:
    """Let every chunk be switched on; whether one can be may be stated for each by itself."""
    selector = nodes.nodes.get("ChunkSelector")
    if selector is None or "ChunkEnable" not in nodes.nodes:
        return
    held = _number_or(nodes, "ChunkSelector", 0)
    last = list(_value_chain(nodes, "ChunkSelector"))[-1]
    for value in (*(nodes.entry_value(entry) for entry in selector.entries), held):
        if nodes.nodes[last].texts("Value"):
            nodes.set_local(last, value)
        elif not _try_write(nodes, "ChunkSelector", value):
            continue
        _write_presence(nodes, ["ChunkEnable"])


def _conditions(nodes: NodeMap, name: str) -> Iterator[str]:
    """Nodes that decide whether a feature, what it stands for or one of its entries exists."""
    visited: set[str] = set()
    while name and name not in visited and name in nodes.nodes:
        visited.add(name)
        node = nodes.nodes[name]
        for part in (node, *node.entries):
            yield from part.texts("pIsImplemented")
            yield from part.texts("pIsAvailable")
        name = node.text("pValue")


def _leaves(nodes: NodeMap, name: str) -> set[str]:
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


def _is_inquiry(nodes: NodeMap, leaf: str) -> bool:
    """Whether a register only states what the camera has: read-only integers."""
    node = nodes.nodes[leaf]
    return node.kind in INTEGER_REGISTERS and node.text("AccessMode") == "RO"


def _search_true(nodes: NodeMap, condition: str) -> None:
    """Try values of the inquiry registers behind a condition until it is true."""
    trials = 0
    for leaf in sorted(_leaves(nodes, condition)):
        if not _is_inquiry(nodes, leaf):
            continue
        before = _number_or(nodes, leaf, 0)
        for value in _candidates(nodes, leaf):
            trials += 1
            if trials > _TRIALS_MAX:
                return
            if _try_write(nodes, leaf, value) and _number_or(nodes, condition, 0):
                return
        _try_write(nodes, leaf, before)


def _candidates(nodes: NodeMap, leaf: str) -> list[int]:
    limits = nodes.limits(leaf)
    bits = max(1, int(limits.maximum).bit_length())
    return [int(limits.maximum), 0, *(1 << bit for bit in range(min(bits, 32)))]


def _is_number(node: Node) -> bool:
    return node.kind in ("Integer", "Float", "Converter", "IntConverter")


def _order_limits(nodes: NodeMap, name: str, held: Collection[str]) -> None:
    """Give a feature a range where its limits are registers or formulas of registers."""
    upper = _SIZES.get(name, _UPPER_LIMITS.get(name, _UPPER_LIMIT))
    for owner in _value_chain(nodes, name):
        for tag, value in (
            ("pInc", 1),
            ("pMin", _LOWER_LIMITS.get(name, 0)),
            ("pMax", upper),
        ):
            source = nodes.nodes[owner].text(tag)
            if source:
                _fill_register(nodes, source, value)
    if not _has_range(nodes, name):
        _search_range(nodes, name, upper, held)


def _has_range(nodes: NodeMap, name: str) -> bool:
    try:
        limits = nodes.limits(name)
        nodes.number(name)
    except NodeError:
        return False
    return limits.maximum - limits.minimum > _RANGE_MIN and limits.increment > 0


def _search_range(nodes: NodeMap, name: str, upper: Number, held: Collection[str]) -> None:
    """Fill empty registers behind a feature until it has a value and a range.

    Registers that hold the value of a feature are left alone.
    """
    leaves = sorted(
        leaf
        for leaf in _leaves(nodes, name)
        if nodes.nodes[leaf].kind not in ("StringReg", "Register")
        and (leaf not in held or nodes.nodes[leaf].text("AccessMode") == "RO")
        and not _number_or(nodes, leaf, 0)
    )
    for value in (upper, 1):
        for leaf in leaves:
            before = _number_or(nodes, leaf, 0)
            if _fill_register(nodes, leaf, value) and _has_range(nodes, name):
                return
            if value == upper:
                _try_write(nodes, leaf, before)


def _value_chain(nodes: NodeMap, name: str) -> Iterator[str]:
    visited: set[str] = set()
    while name and name not in visited and name in nodes.nodes:
        visited.add(name)
        yield name
        name = nodes.nodes[name].text("pValue")


def _fill_register(nodes: NodeMap, source: str, value: Number) -> bool:
    """Write a limit, unless it has a value of its own; whether it was written."""
    if nodes.nodes[source].text("AccessMode") == "RO" and value != 1:
        if _number_or(nodes, source, 0) > 1:
            return False
    elif _number_or(nodes, source, 0):
        return False
    try:
        limits = nodes.limits(source)
    except NodeError:
        return False
    return _try_write(nodes, source, min(value, limits.maximum))


def _write_factory_value(nodes: NodeMap, name: str) -> None:
    node = nodes.nodes[name]
    if node.kind == "Enumeration":
        if not _choose_entry(nodes, name, _FACTORY_ENTRIES.get(name, ())):
            _choose_first_entry(nodes, name)
        return
    if node.kind in ("StringReg", "String", "Command", "Boolean", "Register"):
        return
    wanted = _SIZES.get(name, _FACTORY_VALUES.get(name))
    try:
        limits = nodes.limits(name)
        current = nodes.number(name)
    except NodeError:
        return
    if wanted is None:
        if limits.minimum <= current <= limits.maximum:
            return
        wanted = limits.minimum
    if limits.minimum <= limits.maximum:
        wanted = min(max(wanted, limits.minimum), limits.maximum)
    _try_write(nodes, name, wanted)


def _choose_first_entry(nodes: NodeMap, name: str) -> None:
    """Give an enumeration its first entry if its value is none of them."""
    try:
        current = nodes.symbolic(name)
    except NodeError:
        return
    entries = nodes.nodes[name].entries
    if current is not None and any(
        entry.name == current and nodes.is_implemented(entry) for entry in entries
    ):
        return
    for entry in entries:
        if nodes.is_implemented(entry) and _try_write(nodes, name, nodes.entry_value(entry)):
            return


def _choose_entry(nodes: NodeMap, name: str, wanted: Iterable[str]) -> bool:
    """Write the first of the entries that the enumeration has; whether there is one."""
    node = nodes.nodes.get(name)
    if node is None or node.kind != "Enumeration":
        return False
    for choice in wanted:
        for entry in node.entries:
            if (
                entry.name == choice
                and nodes.is_implemented(entry)
                and _try_write(nodes, name, nodes.entry_value(entry))
            ):
                return True
    return False


def _write_automatic(nodes: NodeMap, features: Iterable[str]) -> None:
    for name in features:
        if name.endswith("Auto") and _is_writable(nodes, name):
            _choose_entry(nodes, name, _AUTOMATIC_ENTRIES)
    for name in _AUTOMATIC_SWITCHES:
        if _is_writable(nodes, name):
            _try_write(nodes, name, 1)


def _is_writable(nodes: NodeMap, name: str) -> bool:
    try:
        return nodes.access(name).is_writable
    except NodeError:
        return False


def _try_write(nodes: NodeMap, name: str, value: Number) -> bool:
    if name not in nodes.nodes:
        return False
    try:
        nodes.write(name, value)
    except (NodeError, OverflowError, ValueError, KeyError, ArithmeticError):
        return False
    return True


def _number_or(nodes: NodeMap, name: str, default: Number) -> Number:
    try:
        return nodes.number(name)
    except NodeError:
        return default
