"""Schemas for STAC without a network.

The core's are those that pystac carries. Those of the extensions are written here from their
specifications (projection 2.0.0, view 1.0.0, file 2.1.0): names, types and ranges of the fields.
Any field with the prefix of an extension that the extension does not have is an error.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pystac.validation.local_validator import get_local_schema_cache

NUMBER = {"type": "number"}


def _of_length(count: int) -> dict[str, int]:
    return {"minItems": count, "maxItems": count}


FIELDS: dict[str, dict[str, Any]] = {
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json": {
        "proj:code": {"type": ["string", "null"], "pattern": "^[A-Z]+:[0-9A-Za-z_-]+$"},
        "proj:wkt2": {"type": ["string", "null"]},
        "proj:projjson": {"type": ["object", "null"]},
        "proj:geometry": {"type": "object"},
        "proj:bbox": {"type": "array", "items": NUMBER, "anyOf": [_of_length(4), _of_length(6)]},
        "proj:centroid": {
            "type": "object",
            "required": ["lat", "lon"],
            "properties": {
                "lat": {"type": "number", "minimum": -90, "maximum": 90},
                "lon": {"type": "number", "minimum": -180, "maximum": 180},
            },
        },
        "proj:shape": {
            "type": "array",
            "items": {"type": "integer", "minimum": 1},
            "minItems": 2,
            "maxItems": 2,
        },
        "proj:transform": {
            "type": "array",
            "items": NUMBER,
            "anyOf": [_of_length(6), _of_length(9)],
        },
    },
    "https://stac-extensions.github.io/view/v1.0.0/schema.json": {
        "view:off_nadir": {"type": "number", "minimum": 0, "maximum": 90},
        "view:incidence_angle": {"type": "number", "minimum": 0, "maximum": 90},
        "view:azimuth": {"type": "number", "minimum": 0, "maximum": 360},
        "view:sun_azimuth": {"type": "number", "minimum": 0, "maximum": 360},
        "view:sun_elevation": {"type": "number", "minimum": -90, "maximum": 90},
    },
    "https://stac-extensions.github.io/file/v2.1.0/schema.json": {
        "file:byte_order": {"enum": ["big-endian", "little-endian"]},
        "file:checksum": {"type": "string", "pattern": "^1220[a-f0-9]{64}$"},
        "file:size": {"type": "integer", "minimum": 0},
    },
}


def schemas() -> dict[str, dict[str, Any]]:
    """Every schema by its address."""
    return {**get_local_schema_cache(), **{uri: _extension(uri) for uri in FIELDS}}


def write_schemas(folder: Path) -> dict[str, str]:
    """The schemas as files, for stac-validator: addresses and paths."""
    folder.mkdir()
    paths = {}
    for index, (uri, schema) in enumerate(schemas().items()):
        path = folder / f"{index}.json"
        path.write_text(json.dumps(schema))
        paths[uri] = str(path)
    return paths


def _extension(uri: str) -> dict[str, Any]:
    prefix = next(iter(FIELDS[uri])).partition(":")[0]
    fields = {
        "type": "object",
        "properties": FIELDS[uri],
        "patternProperties": {f"^(?!{prefix}:)": {}},
        "additionalProperties": False,
    }
    # An item that names view has a field of it; the other two may be without any.
    own = {"anyOf": [{"required": [name]} for name in FIELDS[uri]]} if prefix == "view" else {}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "$id": uri,
        "type": "object",
        "properties": {
            "stac_extensions": {"type": "array", "contains": {"const": uri}},
            "properties": {**fields, **own},
            "links": {"type": "array", "items": fields},
            "assets": {"type": "object", "additionalProperties": fields},
        },
        "required": ["stac_extensions"],
    }
