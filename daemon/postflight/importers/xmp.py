"""Reading the XMP packet of an image: simple values and sequences by their names.

The packet is untrusted input: its size, depth and number of elements are limited, and a document
type or an entity is refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from daemon import DaemonError
from daemon.mission.foreign_xml import XmlError, parse_xml

XMP_MAX_BYTES = 1_000_000
XMP_MAX_ELEMENTS = 10_000
_NUMBERS_MAX = 10
_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"


class XmpError(DaemonError, ValueError):
    """An XMP packet that cannot be used; the message names file, finding and remedy."""


class Xmp:
    """The values of one packet; `file` names it in error messages.

    A key is the local name of a property, such as `BandName`; a value is its text, or the texts of
    its `rdf:li`.
    """

    def __init__(self, values: Mapping[str, Sequence[str]], file: str) -> None:
        self._values = values
        self._file = file

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def text(self, key: str) -> str:
        values = self._values.get(key, ())
        if len(values) != 1:
            raise XmpError(f"{self._file}: XMP {key} has {len(values)} values; one is needed")
        return values[0]

    def texts(self, key: str, *, split: bool = False) -> tuple[str, ...]:
        """All texts of a property, none where it is not there; of one text the parts at commas."""
        values = self._values.get(key, ())
        return tuple(values[0].split(",") if split and len(values) == 1 else values)

    def number(self, key: str) -> float:
        return self._number(key, self.text(key))

    def numbers(self, key: str, count: int | None = None) -> tuple[float, ...]:
        """A sequence of so many numbers, or one text that holds them between commas.

        Without a count, two to `_NUMBERS_MAX` are read.
        """
        values = self._values.get(key, ())
        if len(values) == 1:
            values = values[0].split(",")
        if count is None and not 2 <= len(values) <= _NUMBERS_MAX:
            raise XmpError(f"{self._file}: XMP {key} has {len(values)} values; a few are needed")
        if count is not None and len(values) != count:
            raise XmpError(f"{self._file}: XMP {key} has {len(values)} values; {count} are needed")
        return tuple(self._number(key, value) for value in values)

    def _number(self, key: str, text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise XmpError(f"{self._file}: XMP {key} is {text[:40]!r}; a finite number is needed")
        return number


def read_xmp(packet: bytes, file: str) -> Xmp:
    """Parse a packet.

    Raises:
        XmpError: too large, not UTF-8, not XML, with a document type, or with too many elements.
    """
    if len(packet) > XMP_MAX_BYTES:
        raise XmpError(f"{file}: XMP of {len(packet)} bytes; at most {XMP_MAX_BYTES} are read")
    try:
        text = packet.decode("utf-8").rstrip("\0 \r\n\t")
    except UnicodeDecodeError as error:
        raise XmpError(f"{file}: XMP is not UTF-8 ({error.reason})") from error
    values: dict[str, list[str]] = {}
    try:
        root = parse_xml(text.encode(), elements_max=XMP_MAX_ELEMENTS)
    except XmlError as error:
        raise XmpError(f"{file}: XMP packet: {error}") from error
    for description in root.iter(f"{_RDF}Description"):
        for name, value in description.attrib.items():
            if not name.startswith(_RDF):
                values.setdefault(_local(name), [value.strip()])
        for element in description:
            items = [(item.text or "").strip() for item in element.iter(f"{_RDF}li")]
            values.setdefault(_local(element.tag), items or [(element.text or "").strip()])
    return Xmp(values, file)


def _local(name: str) -> str:
    return name.rpartition("}")[2]
