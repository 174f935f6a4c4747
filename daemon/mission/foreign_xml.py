"""XML of others: parsed once, without document types, and only so deep and so large."""

from __future__ import annotations

from typing import NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

from daemon import DaemonError

DEPTH_MAX = 100


class XmlError(DaemonError, ValueError):
    """XML that cannot be used; the message states what was found."""


def parse_xml(data: bytes, *, elements_max: int) -> ElementTree.Element:
    """Parse a document in any encoding that expat reads; what it declares is seen after decoding.

    Args:
        data: the document.
        elements_max: how many elements it may have.

    Returns:
        The root; names as ElementTree writes them, `{namespace}name`.

    Raises:
        XmlError: not XML, a document type or an entity, nested too deeply, or too many elements.
    """
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate(namespace_separator="}")
    parser.buffer_text = True
    depth = count = 0

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEPTH_MAX:
            raise XmlError(f"elements nested more than {DEPTH_MAX} deep")
        if count > elements_max:
            raise XmlError(f"more than {elements_max} elements")
        builder.start(_named(name), {_named(key): value for key, value in attributes.items()})

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(_named(name))

    def refuse(*_: object) -> NoReturn:
        raise XmlError("it declares a document type or entities, which it does not need")

    parser.StartElementHandler = begin
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError, UnicodeError) as error:
        raise XmlError(f"not valid XML ({error})") from error
    except ValueError as error:
        raise XmlError(str(error)) from error
    return builder.close()


def _named(name: str) -> str:
    return "{" + name if "}" in name else name
