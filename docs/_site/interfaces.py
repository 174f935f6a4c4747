"""Pages of configuration keys, events, flags, metrics and routes, from the code that reads them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from docs._site.tables import sections, table

METHODS: Final = ("get", "post", "put", "delete")
KEYS: Final = ("key", "type", "unit", "default", "range", "meaning")


def pages() -> dict[str, str]:
    """Pages by their path below docs/."""
    return {
        "reference/configuration.md": configuration(),
        "reference/rig-file.md": rig_file(),
        "reference/flight/flags.md": flags(),
        "reference/flight/metrics.md": metrics(),
        "reference/flight/api.md": api(),
    }


def configuration() -> str:
    """Every key of service.toml, and the settings of every driver."""
    from daemon.configuration.model import Configuration

    lines = [
        "# Configuration",
        "",
        "Reference: every section and key of `service.toml`, with type, unit, default and range.",
        "",
        "All errors of a file are reported together. A key that is not listed is refused. Keys of",
        "devices are listed [below](#settings-of-drivers).",
        "",
    ]
    for header, about, rows in sections(Configuration.model_json_schema()):
        if rows:
            lines += [f"## `{header}`", "", about.strip(), "", table(KEYS, rows)]
    return "\n".join([*lines, *_drivers()])


def rig_file() -> str:
    """Every key of a rig file."""
    from processing.rig.rig_file import RigFile

    lines = [
        "# Rig file",
        "",
        "Reference: every table and key of a rig file, with type, unit, default and range.",
        "",
        "[Formats](formats.md#rig-files) states what is checked between keys. `[defaults.lens]` "
        "and",
        "`[defaults.sensor]` hold values for all lenses and sensors that have none of their own.",
        "",
    ]
    for header, about, rows in sections(RigFile.model_json_schema()):
        if rows:
            lines += [f"## `{header}`" if header else "## Top level", ""]
            lines += [about.strip() if header else "", "", table(KEYS, rows)]
    return "\n".join(lines)


def _drivers() -> Iterator[str]:
    from drivers.base import registry

    yield "## Settings of drivers"
    yield ""
    yield "A device has the key `driver` and the settings of that driver."
    yield ""
    for kind, names in registry.kinds().items():
        for name in names:
            rows = [
                (
                    f"`{one.name}`",
                    one.type_name,
                    "required" if one.required else f"`{json.dumps(one.default)}`",
                    _allowed(one),
                    one.help,
                )
                for one in registry.driver_for(kind, name).settings()
            ]
            yield f"### {kind} {name}"
            yield ""
            yield table(("setting", "type", "default", "range", "meaning"), rows)


def _allowed(setting: Any) -> str:
    if setting.choices:
        return ", ".join(f"`{one}`" for one in setting.choices)
    least = "" if setting.minimum is None else f"≥ {setting.minimum:g}"
    most = "" if setting.maximum is None else f"≤ {setting.maximum:g}"
    return ", ".join(filter(None, (least, most)))


def flags() -> str:
    """Every quality flag: bit, cause, action."""
    from daemon.onboard.flight.flag_table import FLAG_TABLE
    from processing.quality.report import Flag

    rows = [
        (f"`{one.name}`", Flag[one.name].bit_length() - 1, one.cause, one.action)
        for one in FLAG_TABLE
    ]
    text = (
        "# Flags\n\n"
        "Reference: the quality flags of an exposure, by name and bit.\n\n"
        "`syntopic explain NAME` prints one entry. The thresholds are in "
        "[formats](../formats.md#qualityjson).\n\n"
    )
    return text + table(("flag", "bit", "cause", "action"), rows)


def metrics() -> str:
    """Every metric, from a scrape of a flight in which everything is known."""
    from prometheus_client.parser import text_string_to_metric_families

    from daemon.onboard.monitoring.metrics import exposition

    rows = []
    for family in text_string_to_metric_families(exposition(full_flight()).decode()):
        labels = sorted({label for sample in family.samples for label in sample.labels})
        name = family.name + ("_total" if family.type == "counter" else "")
        name += "_info" if family.type == "info" else ""
        listed = ", ".join(f"`{label}`" for label in labels)
        rows.append((f"`{name}`", family.type, listed, family.documentation))
    text = (
        "# Metrics\n\nReference: the metrics at `/metrics`, in the text format of Prometheus.\n\n"
    )
    return text + table(("metric", "type", "labels", "meaning"), rows)


def full_flight() -> Any:
    """The state of a flight that has every figure which the metrics report."""
    from daemon.onboard.monitoring.flight_state import FlightState

    disk = {"disk": "root", "state": "in use", "healthy": True, "temperature_c": 40.0}
    state = FlightState("syntopic")
    events: tuple[Mapping[str, Any], ...] = (
        {"event": "device", "mono_ns": "1", "device": "SU00", "name": "ready"},
        {"event": "triggered", "mono_ns": "1", "number": 1},
        {
            "event": "processed",
            "mono_ns": "1",
            "number": 1,
            "duration_s": 0.5,
            "report": {"verdict": "good", "flags": [], "findings": [], "figures": {}},
        },
        {
            "event": "status",
            "mono_ns": "1",
            "phase": "flying",
            "ledger": {},
            "exposures_left": 100,
            "clock_sigma_ns": 25,
            "temperatures_c": {"0": 32.0},
            "disks": [disk | {"wear_percent": 3}],
        },
    )
    for event in events:
        state.apply(event)
    return state


def api() -> str:
    """Every route, from the OpenAPI document that the service serves."""
    lines = [
        "# API",
        "",
        "Reference: the routes of the operator's page and API.",
        "",
        "The service serves the same as OpenAPI at `/openapi.json` and as a page at `/docs`.",
        "[Monitoring a flight](../../how-to/flight/watching.md) explains tokens and roles.",
        "",
    ]
    schema = openapi()
    for path, operations in schema["paths"].items():
        for method in METHODS:
            if method in operations:
                lines += _route(method, path, operations[method], schema)
    return "\n".join(lines)


def openapi() -> dict[str, Any]:
    """The OpenAPI document of a service without tokens."""
    from daemon.onboard.monitoring.access.command_gateway import CommandGateway
    from daemon.onboard.monitoring.access.tokens import Tokens
    from daemon.onboard.monitoring.flight_state import FlightState
    from daemon.onboard.monitoring.web.api import AccessSettings, create_app

    async def described() -> dict[str, Any]:
        gateway = CommandGateway(lambda _: None)
        return create_app(FlightState("syntopic"), gateway, AccessSettings(Tokens({}))).openapi()

    return asyncio.run(described())


def _route(
    method: str, path: str, operation: Mapping[str, Any], schema: Mapping[str, Any]
) -> list[str]:
    lines = [f"## {method.upper()} {path}", "", str(operation.get("description", "")), ""]
    parameters = [
        (f"`{one['name']}`", one["in"], _schema_text(one["schema"]), one.get("description", ""))
        for one in operation.get("parameters", ())
    ]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    if body:
        parameters.append(("body", "JSON", _schema_text(body["schema"]), ""))
        named = body["schema"].get("$ref", "").rpartition("/")[2]
        fields = schema.get("components", {}).get("schemas", {}).get(named, {})
        parameters += [
            (f"`{key}`", "body", _schema_text(one), one.get("description", ""))
            for key, one in fields.get("properties", {}).items()
        ]
    if parameters:
        lines += [table(("parameter", "in", "type", "meaning"), parameters)]
    answers = [(f"`{s}`", one.get("description", "")) for s, one in operation["responses"].items()]
    return [*lines, table(("status", "answer"), answers)]


def _schema_text(schema: Mapping[str, Any]) -> str:
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "enum" in schema:
        return ", ".join(f"`{one}`" for one in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(_schema_text(one) for one in schema["anyOf"])
    text = str(schema.get("type", "any"))
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    limits = [f"{sign} {schema[name]:g}" for name, sign in signs.items() if name in schema]
    return ", ".join([text, *limits])
