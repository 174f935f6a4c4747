"""Writing a rig as a rig file: what `processing.rig` reads back is the same rig.

For importers, which put the calibration of one camera into the file of its kind.
"""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

from daemon.configuration.schemas import schema_line
from processing.rig import RIG_FORMAT, Cone, Rig, Sensor


def rig_toml(rig: Rig, *, remark: str = "", names_schema: bool = True) -> bytes:
    """The rig as TOML; `remark` becomes the comment at the top.

    With `names_schema` the first line names the schema in the same folder, for editors.
    """
    lines = [schema_line("rig")] if names_schema else []
    lines += [f"# {line}".rstrip() for line in remark.splitlines()]
    lines += _pairs(
        {
            "format": RIG_FORMAT,
            "name": rig.name,
            "title": rig.title,
            **({"serial": rig.serial} if rig.serial else {}),
            "timing": rig.timing,
            "frame_interval_s": rig.frame_interval_s,
            "master_cone": rig.master_cone or "",
            "colour_master_cone": rig.colour_master_cone or "",
            "reference_cone": rig.reference_cone,
        }
    )
    if rig.is_calibrated:
        lines += ["", "[calibration]"]
        lines += _pairs(
            {
                "id": rig.calibration_id,
                "date": rig.calibration_date,
                "valid_days": rig.calibration_valid_days,
            }
        )
    if rig.virtual_image is not None:
        lines += ["", "[virtual_image]", *_pairs(_values(rig.virtual_image))]
    if rig.probe_serials:
        named = {json.dumps(name): serial for name, serial in rig.probe_serials.items()}
        lines += ["", "[probe_serials]", *_pairs(named)]
    for cone in rig.cones:
        lines += ["", "[[cone]]", *_cone(cone)]
    return ("\n".join(lines) + "\n").encode("utf-8")


def _cone(cone: Cone) -> list[str]:
    values = _values(cone, without=("lens", "sensors"))
    lens = _values(cone.lens, without=("residual_grid",))
    lines = [*_pairs(values), "", "[cone.lens]", *_pairs(lens)]
    if cone.lens.residual_grid is not None:
        lines += ["", "[cone.lens.residual_grid]", *_pairs(_values(cone.lens.residual_grid))]
    for sensor in cone.sensors:
        lines += ["", "[[cone.sensor]]", *_sensor(sensor)]
    return lines


def _sensor(sensor: Sensor) -> list[str]:
    lines = _pairs(_values(sensor, without=("drift",)))
    return [*lines, "", "[cone.sensor.drift]", *_pairs(_values(sensor.drift))]


def _values(record: Any, without: tuple[str, ...] = ()) -> dict[str, Any]:
    names = [field.name for field in fields(record) if field.name not in without]
    return {name: getattr(record, name) for name in names}


def _pairs(values: dict[str, Any]) -> list[str]:
    return [f"{key} = {_toml_value(value)}" for key, value in values.items()]


def _toml_value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml_value(item) for item in value)}]"
    if isinstance(value, str):
        # A JSON string in ASCII is a TOML basic string, but for DEL, which no name holds.
        return json.dumps(value)
    return repr(value)
