"""The GenICam description of a head: XML, schema 1.1, made from the table of features.

A controller reads it from the head's memory to find the registers of the features.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

from sim_hw.gige.features import (
    CHUNK_FEATURES,
    CHUNK_IDS,
    CHUNKS,
    BooleanFeature,
    ChunkFeature,
    CommandFeature,
    EnumerationFeature,
    Feature,
    FloatFeature,
    IntegerFeature,
    StringFeature,
)

_CHUNK_CATEGORY = "ChunkDataControl"


def description_xml(features: Sequence[Feature], vendor: str, model: str) -> bytes:
    """The XML file of a head with these features."""
    categories: dict[str, list[str]] = {}
    for feature in features:
        categories.setdefault(feature.category, []).append(feature.name)
    categories.setdefault(_CHUNK_CATEGORY, []).extend(chunk.name for chunk in CHUNK_FEATURES)
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<RegisterDescription ModelName={quoteattr(_identifier(model))}"
        f" VendorName={quoteattr(_identifier(vendor))}"
        ' ToolTip="" StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1"'
        ' SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" SubMinorVersion="0"'
        ' ProductGuid="5C3B2A90-7A51-4E7E-9E0B-2D8E4F1C6A01"'
        ' VersionGuid="5C3B2A90-7A51-4E7E-9E0B-2D8E4F1C6A02"'
        ' xmlns="http://www.genicam.org/GenApi/Version_1_1">',
        _category("Root", list(categories)),
    ]
    lines += [_category(name, members) for name, members in categories.items()]
    lines += [_node(feature) for feature in features]
    lines += [_chunk_node(chunk) for chunk in CHUNK_FEATURES]
    lines += ['<Port Name="Device"/>', "</RegisterDescription>"]
    return "\n".join(lines).encode("utf-8")


def _identifier(text: str) -> str:
    return "".join(c if c.isalnum() and c.isascii() else "_" for c in text) or "_"


def _category(name: str, members: Sequence[str]) -> str:
    inside = "".join(f"<pFeature>{member}</pFeature>" for member in members)
    return f'<Category Name="{name}">{inside}</Category>'


def _node(feature: Feature) -> str:
    match feature:
        case IntegerFeature():
            maximum = feature.maximum if feature.length == 4 else 2**63 - 1
            minimum = -(2**63) if feature.is_signed else feature.minimum
            register = _integer_register(feature, feature.bits, is_signed=feature.is_signed)
            return (
                f'<Integer Name="{feature.name}"><pValue>{feature.name}Register</pValue>'
                f"<Min>{minimum}</Min><Max>{maximum}</Max><Inc>{feature.increment}</Inc>"
                f"{_unit(feature.unit)}</Integer>{register}"
            )
        case FloatFeature():
            return (
                f'<Float Name="{feature.name}"><pValue>{feature.name}Register</pValue>'
                f"<Min>{feature.minimum!r}</Min><Max>{feature.maximum!r}</Max>"
                f"{_unit(feature.unit)}</Float>"
                f'<FloatReg Name="{feature.name}Register">{_place(feature)}'
                "<Endianess>BigEndian</Endianess></FloatReg>"
            )
        case EnumerationFeature():
            entries = "".join(
                f'<EnumEntry Name="{name}"><Value>{value}</Value></EnumEntry>'
                for name, value in feature.entries.items()
            )
            selected = (
                "<pSelected>ChunkEnable</pSelected>" if feature.name == "ChunkSelector" else ""
            )
            return (
                f'<Enumeration Name="{feature.name}">{entries}'
                f"<pValue>{feature.name}Register</pValue>{selected}</Enumeration>"
                + _integer_register(feature)
            )
        case BooleanFeature():
            return (
                f'<Boolean Name="{feature.name}"><pValue>{feature.name}Register</pValue>'
                "<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>"
                + _integer_register(
                    feature,
                    None if feature.bit is None else (feature.bit, feature.bit),
                    feature.selector,
                )
            )
        case CommandFeature():
            return (
                f'<Command Name="{feature.name}"><pValue>{feature.name}Register</pValue>'
                f"<CommandValue>{feature.value}</CommandValue></Command>"
                + _integer_register(
                    feature, None if feature.bit is None else (feature.bit, feature.bit)
                )
            )
        case StringFeature():
            return f'<StringReg Name="{feature.name}">{_place(feature)}</StringReg>'
    raise TypeError(f"no GenICam node is known for a {type(feature).__name__}")


def _place(feature: Feature, selector: str | None = None) -> str:
    index = f'<pIndex Offset="4">{selector}</pIndex>' if selector else ""
    length = 4 if selector else feature.length
    return (
        f"<Address>0x{feature.address:X}</Address>{index}<Length>{length}</Length>"
        f"<AccessMode>{feature.access}</AccessMode><pPort>Device</pPort>"
        "<Cachable>NoCache</Cachable>"
    )


def _integer_register(
    feature: Feature,
    bits: tuple[int, int] | None = None,
    selector: str | None = None,
    *,
    is_signed: bool = False,
) -> str:
    name = f"{feature.name}Register"
    sign = "Signed" if is_signed else "Unsigned"
    end = f"<Sign>{sign}</Sign><Endianess>BigEndian</Endianess>"
    if bits is None:
        return f'<IntReg Name="{name}">{_place(feature, selector)}{end}</IntReg>'
    # GenICam counts the bits of a big-endian register from the most significant one.
    lowest, highest = 31 - bits[0], 31 - bits[1]
    where = (
        f"<Bit>{lowest}</Bit>" if lowest == highest else f"<LSB>{lowest}</LSB><MSB>{highest}</MSB>"
    )
    return f'<MaskedIntReg Name="{name}">{_place(feature, selector)}{where}{end}</MaskedIntReg>'


def _chunk_node(chunk: ChunkFeature) -> str:
    port = f"{chunk.name}Port"
    place = (
        "<Address>0</Address><Length>8</Length><AccessMode>RO</AccessMode>"
        f"<pPort>{port}</pPort><Cachable>NoCache</Cachable>"
    )
    if chunk.is_float:
        value = (
            f'<Float Name="{chunk.name}"><pValue>{chunk.name}Register</pValue>'
            f"{_unit(chunk.unit)}</Float>"
            f'<FloatReg Name="{chunk.name}Register">{place}<Endianess>BigEndian</Endianess>'
            "</FloatReg>"
        )
    else:
        value = (
            f'<Integer Name="{chunk.name}"><pValue>{chunk.name}Register</pValue>'
            f"{_unit(chunk.unit)}</Integer>"
            f'<IntReg Name="{chunk.name}Register">{place}<Sign>Unsigned</Sign>'
            "<Endianess>BigEndian</Endianess></IntReg>"
        )
    assert chunk.chunk in CHUNKS
    return f'{value}<Port Name="{port}"><ChunkID>{CHUNK_IDS[chunk.chunk]:08X}</ChunkID></Port>'


def _unit(unit: str) -> str:
    return f"<Unit>{unit}</Unit>" if unit else ""
