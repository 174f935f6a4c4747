"""Our reading of GenApi against the reference implementation of the GenICam committee.

Over the same registers, every feature of every real description has the same access mode and
value in both.
"""

from __future__ import annotations

import math
from typing import Any

import pytest

from sim_hw.gige.described_registers import SparseMemory
from sim_hw.gige.genicam.description_file import read_description
from sim_hw.gige.genicam.node_map import Access, NodeError, NodeMap
from sim_hw.gige.genicam.power_on_state import (
    InitialState,
    controller_selectors,
    features_of,
    write_power_on_state,
)
from tests.support.genicam_descriptions import description, names, needs_descriptions
from tests.support.genicam_reference import Port, genapi

pytestmark = [needs_descriptions, pytest.mark.peer]

DIFFERENCES_MAX = 5
"""Features per description in which the two may differ."""
ACCESS = {
    genapi.EAccessMode.RW: Access.READ_WRITE,
    genapi.EAccessMode.RO: Access.READ_ONLY,
    genapi.EAccessMode.WO: Access.WRITE_ONLY,
    genapi.EAccessMode.NA: Access.NOT_AVAILABLE,
    genapi.EAccessMode.NI: Access.NOT_IMPLEMENTED,
}


def is_same(theirs: Any, ours: float) -> bool:
    if isinstance(theirs, float) and not math.isfinite(theirs):
        return True
    return math.isclose(float(theirs), float(ours), rel_tol=1e-9, abs_tol=1e-12)


# State by state within a description, which is read once for both.
@pytest.mark.parametrize("state", [InitialState.FACTORY, InitialState.USER_SET])
@pytest.mark.parametrize("name", names())
def test_access_and_values_are_those_of_the_reference(name: str, state: InitialState) -> None:
    found = read_description(description(name))
    memory = SparseMemory()
    nodes = NodeMap(found, memory)
    write_power_on_state(nodes, state)
    reference = genapi.NodeMap()
    reference.load_xml_from_string(found.xml.decode("utf-8", "replace"))
    port = Port(memory)
    for node in found.nodes.values():
        if node.kind == "Port" and not (node.texts("ChunkID") or node.texts("EventID")):
            reference.connect(port, node.name)
    # Selectors without a register: each controller sets its own.
    for selector in controller_selectors(nodes):
        theirs = reference.get_node(selector)
        if theirs.get_access_mode() == genapi.EAccessMode.RW:
            is_enumeration = nodes.nodes[selector].kind == "Enumeration"
            write = theirs.set_int_value if is_enumeration else theirs.set_value
            write(int(nodes.number(selector)))
    compared, differences = 0, []
    for feature in features_of(nodes):
        theirs = reference.get_node(feature)
        if theirs is None or found.nodes[feature].kind == "Port":
            continue
        compared += 1
        access = nodes.access(feature)
        if ACCESS.get(theirs.get_access_mode()) is not access:
            differences.append(f"{feature}: {theirs.get_access_mode()} there, {access.name} here")
        elif access.is_readable and found.nodes[feature].kind in ("Integer", "Float"):
            try:
                value = theirs.value
            except genapi.GenericException:
                continue
            try:
                same = is_same(value, nodes.number(feature))
            except NodeError:
                same = False
            if not same:
                differences.append(f"{feature}: {value} there")
    assert compared > 5
    assert len(differences) <= DIFFERENCES_MAX, differences
