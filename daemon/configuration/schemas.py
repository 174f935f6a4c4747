"""JSON Schemas of `rig.toml` and `service.toml`, for editors; made from the models.

`python -m daemon.configuration.schemas` writes the files that come with the package. Rules between
keys, such as names that are unique, are checked by the readers only.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import processing.rig
from daemon.configuration.model import (
    Configuration,
    DeviceSection,
    HeadDeviceSection,
    NamedDeviceSection,
    TriggerSection,
)
from drivers.base import registry
from drivers.base.settings import Setting
from processing.rig.rig_file import DIRECTION, RigFile

_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
SCHEMA_FILES: Final = {
    "rig": Path(processing.rig.__file__).with_name("rig.schema.json"),
    "service": Path(__file__).with_name("service.schema.json"),
}
"""JSON Schemas that come with the package, by the name of what they describe."""
_TYPES: Final[Mapping[type, Mapping[str, Any]]] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
    tuple: {"type": "array", "items": {"type": "string", "minLength": 1}},
    dict: {
        "type": "object",
        "additionalProperties": {"type": ["boolean", "number", "string"]},
    },
}
"""Of a setting, by the type of its default."""


def schema_file_name(name: str) -> str:
    """Name of the schema file next to a TOML file: "rig" or "service"."""
    return SCHEMA_FILES[name].name


def schema_line(name: str) -> str:
    """First line of a TOML file, from which editors find its schema in the same folder."""
    return f"#:schema ./{schema_file_name(name)}"


def rig_schema() -> dict[str, Any]:
    """The schema of a rig file. A key of a lens or a sensor may be in `[defaults]` instead."""
    schema = RigFile.model_json_schema()
    definitions = schema["$defs"]
    definitions["Lens"].pop("required")
    definitions["Lens"]["properties"]["direction"] = {"const": DIRECTION}
    definitions["Sensor"].pop("required")
    for name in ("Lens", "Sensor"):
        definitions["DefaultsTable"]["properties"][name.lower()] = {"$ref": f"#/$defs/{name}"}
    definitions["Cone"]["properties"]["sensor"]["items"]["required"] = ["name"]
    return _headed(schema, "Rig file of Syntopic (rig.toml)")


def service_schema() -> dict[str, Any]:
    """The schema of a service configuration, with the settings of every driver."""
    schema = Configuration.model_json_schema()
    definitions = schema["$defs"]
    sections: Mapping[str, type[DeviceSection] | type[TriggerSection]] = {
        "trigger": TriggerSection,
        "head": HeadDeviceSection,
        "thermometer": NamedDeviceSection,
        "navigator": NamedDeviceSection,
        "pps": NamedDeviceSection,
    }
    for kind, section in sections.items():
        own = section.model_json_schema()
        drivers = registry.kinds()[kind]
        definitions |= {f"{kind}.{driver}": _device(kind, driver, own) for driver in drivers}
        chosen = {
            "type": "object",
            "properties": {"driver": {"enum": list(drivers)}},
            "required": ["driver"],
            "allOf": [
                {
                    "if": {"properties": {"driver": {"const": driver}}},
                    "then": {"$ref": f"#/$defs/{kind}.{driver}"},
                }
                for driver in drivers
            ],
        }
        if kind == "trigger":
            schema["properties"][kind] = chosen
        else:
            schema["properties"][kind]["items"] = chosen
    for section in set(sections.values()):
        definitions.pop(section.__name__, None)
    return _headed(schema, "Configuration of the Syntopic service (service.toml)")


def schema_text(name: str) -> str:
    """The exact content of a schema's file, `rig` or `service`."""
    schema = {"rig": rig_schema, "service": service_schema}[name]()
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


def _device(kind: str, driver: str, section: Mapping[str, Any]) -> dict[str, Any]:
    """A section whose driver is this one: the keys of its kind, and the driver's settings."""
    settings = registry.driver_for(kind, driver).settings()
    return {
        "type": "object",
        "description": section["description"],
        "properties": {
            **section["properties"],
            "driver": {"const": driver},
            **{setting.name: _setting(setting) for setting in settings},
        },
        "required": [*section["required"], *(s.name for s in settings if s.required)],
        "additionalProperties": False,
    }


def _setting(setting: Setting[Any]) -> dict[str, Any]:
    kind = type(setting.default)
    schema = {**_TYPES[kind], "description": setting.help}
    limits = ("minItems", "maxItems") if kind is tuple else ("minimum", "maximum")
    for key, value in zip(limits, (setting.minimum, setting.maximum), strict=True):
        if value is not None:
            schema[key] = int(value) if kind is tuple else value
    if setting.choices:
        schema["enum"] = list(setting.choices)
    if not setting.required:
        schema["default"] = list(setting.default) if kind is tuple else setting.default
    elif kind is str:
        schema["minLength"] = 1
    return schema


def _headed(schema: dict[str, Any], title: str) -> dict[str, Any]:
    return {"$schema": _DIALECT, **_for_toml(schema), "title": title}


def _for_toml(schema: Any) -> Any:
    """A schema without null, which TOML has not, and without titles that repeat the key."""
    if isinstance(schema, list):
        return [_for_toml(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    plain = {
        key: _for_toml(value)
        for key, value in schema.items()
        if value is not None and (key != "title" or isinstance(value, dict))
    }
    match plain.get("anyOf"):
        case [option, {"type": "null"}]:
            plain = {**option, **plain}
            del plain["anyOf"]
    return plain


if __name__ == "__main__":
    for schema_name, path in SCHEMA_FILES.items():
        path.write_text(schema_text(schema_name), encoding="utf-8")
