"""Registers of a camera after power-on, made from its description alone.

A description states which registers a camera has and what they mean, not what they hold. This
module chooses values under which the features of the description are implemented and available,
their limits are in order, and every enumeration has a valid entry.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from enum import Enum

from sim_hw.gige.genicam.description_file import Node
from sim_hw.gige.genicam.formula import Number
from sim_hw.gige.genicam.node_map import REGISTERS, NodeError, NodeMap
from sim_hw.gige.genicam.presence import (
    leaves_of,
    number_or,
    try_write,
    unlock,
    value_chain,
    write_bases,
    write_presence,
    write_selected_presence,
)

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
    SPARSE = "sparse"
    """The simplest camera of the family: only what a triggered frame needs is implemented."""


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
    "DigitalShift": 2,
    "GevSCPSBigEndian": 1,
}
_USER_ENTRIES: Mapping[str, tuple[str, ...]] = {
    "AcquisitionMode": ("SingleFrame", "MultiFrame"),
    "ExposureMode": ("TriggerWidth", "TriggerControlled"),
    "TriggerMode": ("On",),
    "TriggerSource": ("Line2", "Line1", "Line0", "Freerun"),
    "TriggerSelector": ("AcquisitionStart", "FrameBurstStart"),
    "TestPattern": ("GreyHorizontalRamp", "HorizontalRamp", "Increasing"),
    "TestImageSelector": ("GreyHorizontalRamp", "Testimage1", "TestImage1", "TestPattern1"),
    "DeviceStreamChannelEndianness": ("Big",),
    "ImageCompressionMode": ("Lossless", "JPEG", "On"),
}
_NEEDED = (
    *("AcquisitionMode", "AcquisitionStart", "AcquisitionStop", "PayloadSize", "PixelFormat"),
    *("Width", "Height", "WidthMax", "HeightMax", "SensorWidth", "SensorHeight"),
    *("ExposureMode", "ExposureTime", "ExposureTimeAbs", "ExposureTimeRaw", "ExposureTimeBaseAbs"),
    *("TriggerSelector", "TriggerMode", "TriggerSource", "TriggerSoftware"),
    *("AcquisitionBurstFrameCount", "GevSCPSPacketSize"),
)
"""What the simplest camera implements, as far as its description has it."""
_SELECTED = (
    ("ChunkSelector", ("ChunkEnable",)),
    ("TriggerSelector", ("TriggerMode", "TriggerSource", "TriggerSoftware", "TriggerDelay")),
)
"""Selectors, and features whose presence is stated for each of their entries."""
_RANGE_MIN = 10


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
    present = [name for name in _NEEDED if name in nodes.nodes]
    if state is not InitialState.SPARSE:
        present = features
    for selector, values in controller_selectors(nodes).items():
        nodes.set_local(selector, values[0])
    held = {register for name in features for register in value_chain(nodes, name)}
    write_bases(nodes)
    write_presence(nodes, present, held)
    known = [name for name in (*_SIZES, *_UPPER_LIMITS) if name in nodes.nodes]
    for name in dict.fromkeys((*known, *features)):
        if _is_number(nodes.nodes[name]):
            _order_limits(nodes, name, held)
            _write_factory_value(nodes, name)
    for name in features:
        _write_factory_value(nodes, name)
    unlock(nodes, present)
    # Conditions may depend on values that have just been written.
    write_presence(nodes, present, held)
    for selector, selected in _SELECTED:
        write_selected_presence(nodes, selector, set(selected) & set(present), held)
    if state is InitialState.AUTOMATIC:
        _write_automatic(nodes, features)
    elif state is InitialState.USER_SET:
        for name, value in _USER_VALUES.items():
            if _is_writable(nodes, name):
                try_write(nodes, name, value)
        for name, entries in _USER_ENTRIES.items():
            if _is_writable(nodes, name):
                _choose_entry(nodes, name, entries)


def _is_number(node: Node) -> bool:
    return node.kind in ("Integer", "Float", "Converter", "IntConverter")


def _order_limits(nodes: NodeMap, name: str, held: Collection[str]) -> None:
    """Give a feature a range where its limits are registers or formulas of registers."""
    upper = _SIZES.get(name, _UPPER_LIMITS.get(name, _UPPER_LIMIT))
    for owner in value_chain(nodes, name):
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
        for leaf in leaves_of(nodes, name)
        if nodes.nodes[leaf].kind not in ("StringReg", "Register")
        and (leaf not in held or nodes.nodes[leaf].text("AccessMode") == "RO")
        and not number_or(nodes, leaf, 0)
    )
    for value in (upper, 1):
        for leaf in leaves:
            before = number_or(nodes, leaf, 0)
            if _fill_register(nodes, leaf, value) and _has_range(nodes, name):
                return
            if value == upper:
                try_write(nodes, leaf, before)


def _fill_register(nodes: NodeMap, source: str, value: Number) -> bool:
    """Write a limit, unless it has a value of its own; whether it was written."""
    if nodes.nodes[source].text("AccessMode") == "RO" and value != 1:
        if number_or(nodes, source, 0) > 1:
            return False
    elif number_or(nodes, source, 0):
        return False
    try:
        limits = nodes.limits(source)
    except NodeError:
        return False
    return try_write(nodes, source, min(value, limits.maximum))


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
    if node.text("ValidValueSet"):
        wanted = int(node.text("ValidValueSet").split(";")[0], 0)
    if wanted is None:
        if limits.minimum <= current <= limits.maximum:
            return
        wanted = limits.minimum
    if limits.minimum <= limits.maximum:
        wanted = min(max(wanted, limits.minimum), limits.maximum)
    try_write(nodes, name, wanted)


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
        if nodes.is_implemented(entry) and try_write(nodes, name, nodes.entry_value(entry)):
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
                and try_write(nodes, name, nodes.entry_value(entry))
            ):
                return True
    return False


def _write_automatic(nodes: NodeMap, features: Iterable[str]) -> None:
    for name in features:
        if name.endswith("Auto") and _is_writable(nodes, name):
            _choose_entry(nodes, name, _AUTOMATIC_ENTRIES)
    for name in _AUTOMATIC_SWITCHES:
        if _is_writable(nodes, name):
            try_write(nodes, name, 1)


def _is_writable(nodes: NodeMap, name: str) -> bool:
    try:
        return nodes.access(name).is_writable
    except NodeError:
        return False
