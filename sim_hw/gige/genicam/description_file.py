"""Read a GenICam description: the nodes of a camera by name.

Source: GenICam Standard 2.1.1, section 2 (GenApi), schemas 1.0 and 1.1.
"""

from __future__ import annotations

import functools
import io
import lzma
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from xml.etree import ElementTree

from sim_hw import SimulatorError

_CONTAINERS = frozenset({"Group", "RegisterDescription"})
_ADDRESS_FORMULAS = frozenset({"IntSwissKnife", "SwissKnife"})
"""Inside a register, these are parts of its address."""
_BIT_PROPERTIES = frozenset({"Bit", "LSB", "MSB", "Sign"})
_DESCRIPTION_MAX_NBYTES = 64 << 20
_UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")


class DescriptionError(SimulatorError, ValueError):
    """A file that is no GenICam description."""


@dataclass(frozen=True)
class Property:
    """One element of a node: its text and its attributes."""

    text: str
    attributes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Node:
    """One node: its kind (such as `IntReg`), name and elements by tag, in order."""

    kind: str
    name: str
    properties: Mapping[str, tuple[Property, ...]]
    entries: tuple[Node, ...] = ()

    def text(self, tag: str, default: str = "") -> str:
        """The text of the first element with this tag."""
        found = self.properties.get(tag)
        return found[0].text if found else default

    def texts(self, tag: str) -> list[str]:
        """The texts of all elements with this tag."""
        return [item.text for item in self.properties.get(tag, ())]


@dataclass(frozen=True)
class Description:
    """The description of one camera: vendor, model and nodes."""

    vendor: str
    model: str
    namespace: str
    schema: tuple[int, int]
    nodes: Mapping[str, Node]
    xml: bytes
    stored: bytes
    """As the camera stores it: the XML, or an archive with it."""

    @property
    def file_name(self) -> str:
        """Name of the stored file, whose suffix is its kind."""
        return "head.xml" if self.stored is self.xml else "head.zip"


# Emulated heads of one camera share what was read; a description is never written.
@functools.lru_cache(maxsize=4)
def read_description(data: bytes) -> Description:
    """Read a description as a camera stores it, also zipped.

    Text before the first `<` and after the last `>`, which programs write that save a description
    and cameras that fill their memory, is skipped.

    Raises:
        DescriptionError: it is no GenICam description.
    """
    archive = b""
    if data[:2] == b"PK":
        archive, data = data, _unzip(data)
    xml = data
    if data[:2] not in _UTF_16_MARKS:
        xml = data[max(data.find(b"<"), 0) : data.rfind(b">") + 1]
    if not xml or len(xml) > _DESCRIPTION_MAX_NBYTES:
        raise DescriptionError("the file contains no XML; save the description of a camera")
    try:
        root = _root_of(xml)
    except ElementTree.ParseError as error:
        raise DescriptionError(f"the XML cannot be read: {error}") from None
    if _tag(root) != "RegisterDescription":
        raise DescriptionError(f"the root is {_tag(root)}; a description has RegisterDescription")
    nodes = {node.name: node for node in _nodes(root)}
    return Description(
        vendor=root.get("VendorName", ""),
        model=root.get("ModelName", ""),
        namespace=root.get("StandardNameSpace", ""),
        schema=(_version(root, "SchemaMajorVersion"), _version(root, "SchemaMinorVersion")),
        nodes=nodes,
        xml=xml,
        stored=archive or xml,
    )


def _root_of(xml: bytes) -> ElementTree.Element:
    """The root; what is not in the encoding it states is read as UTF-8, else as Windows-1252."""
    try:
        return ElementTree.fromstring(xml)
    except ElementTree.ParseError:
        try:
            text = xml.decode("utf-8")
        except UnicodeDecodeError:
            text = xml.decode("cp1252", "replace")
        # A text is read without regard to the encoding that it states.
        return ElementTree.fromstring(text)


def _version(root: ElementTree.Element, attribute: str) -> int:
    text = root.get(attribute, "")
    return int(text) if text.isdigit() else 1


def _unzip(data: bytes) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = [name for name in archive.namelist() if name.lower().endswith(".xml")]
            if not names or archive.getinfo(names[0]).file_size > _DESCRIPTION_MAX_NBYTES:
                raise DescriptionError("the archive contains no description")
            return archive.read(names[0])
    except (
        zipfile.BadZipFile,
        zlib.error,
        lzma.LZMAError,
        OSError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise DescriptionError(f"the archive cannot be read: {error}") from None


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _nodes(parent: ElementTree.Element) -> Iterator[Node]:
    for element in parent:
        kind = _tag(element)
        if kind in _CONTAINERS:
            yield from _nodes(element)
        elif kind == "StructReg":
            yield from _struct_entries(element)
            yield from _address_formulas(element)
        elif element.get("Name"):
            yield _node(kind, element)
            yield from _address_formulas(element)


def _address_formulas(register: ElementTree.Element) -> Iterator[Node]:
    for element in register:
        if _tag(element) in _ADDRESS_FORMULAS and element.get("Name"):
            yield _node(_tag(element), element)


def _node(kind: str, element: ElementTree.Element) -> Node:
    entries = tuple(_node("EnumEntry", e) for e in element if _tag(e) == "EnumEntry")
    return Node(kind, element.get("Name", ""), _properties(element), entries)


def _properties(element: ElementTree.Element) -> dict[str, tuple[Property, ...]]:
    found: dict[str, tuple[Property, ...]] = {}
    for child in element:
        tag = _tag(child)
        if tag in _ADDRESS_FORMULAS:
            tag, text = "pAddress", child.get("Name", "")
        else:
            text = (child.text or "").strip()
        if tag != "EnumEntry":
            found[tag] = (*found.get(tag, ()), Property(text, dict(child.attrib)))
    return found


def _struct_entries(element: ElementTree.Element) -> Iterator[Node]:
    """A StructReg is one register; each entry is a MaskedIntReg with its own bits."""
    common = {
        tag: found
        for tag, found in _properties(element).items()
        if tag not in _BIT_PROPERTIES | {"StructEntry"}
    }
    for entry in element:
        if _tag(entry) == "StructEntry":
            own = _properties(entry)
            yield Node("MaskedIntReg", entry.get("Name", ""), {**common, **own})
