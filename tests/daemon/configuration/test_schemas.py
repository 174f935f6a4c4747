"""The JSON Schemas that come with the package are those of the models, and editors can use them."""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.configuration.schemas import SCHEMA_FILES, schema_text
from drivers.base import registry
from processing.rig import shipped_rigs
from tests.daemon.configuration.test_configuration import GOOD

Validator = jsonschema_rs.Draft202012Validator
MINI = tomllib.loads(shipped_rigs()["ultracam-x-mini"].read_text())


def validator(name: str) -> Validator:
    schema = json.loads(SCHEMA_FILES[name].read_text(encoding="utf-8"))
    assert jsonschema_rs.meta.is_valid(schema)
    return Validator(schema)


def places(name: str, content: Any) -> set[str]:
    """Places of all mistakes that the schema finds, as paths."""
    return {
        "/".join(map(str, error.instance_path)) for error in validator(name).iter_errors(content)
    }


@pytest.mark.parametrize("name", sorted(SCHEMA_FILES))
def test_a_shipped_schema_is_that_of_the_models(name: str) -> None:
    text = SCHEMA_FILES[name].read_text(encoding="utf-8")
    assert text == schema_text(name), "run: make schemas"
    assert CliRunner().invoke(app, ["schema", name]).stdout == text


@pytest.mark.parametrize("name", sorted(shipped_rigs()))
def test_every_shipped_rig_follows_the_schema(name: str) -> None:
    assert places("rig", tomllib.loads(shipped_rigs()[name].read_text())) == set()


def changed(content: dict[str, Any], change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    copied = copy.deepcopy(content)
    change(copied)
    return copied


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda rig: rig["cone"][1]["sensor"][0].update(pitch_um=-7.2), "cone/1/sensor/0/pitch_um"),
        (lambda rig: rig["cone"][0]["sensor"][0].update(pitch=7.2), "cone/0/sensor/0"),
        (lambda rig: rig["cone"][0]["sensor"][0].pop("name"), "cone/0/sensor/0"),
        (lambda rig: rig["cone"][0]["lens"].update(f_mm="long"), "cone/0/lens/f_mm"),
        (lambda rig: rig["cone"][0]["lens"].update(direction="back"), "cone/0/lens/direction"),
        (lambda rig: rig["cone"][0].update(bands=["ultraviolet"]), "cone/0/bands/0"),
        (lambda rig: rig["cone"][0].update(position_mm=[0.0, 0.0]), "cone/0/position_mm"),
        (lambda rig: rig["defaults"]["sensor"].update(bits=17), "defaults/sensor/bits"),
        (lambda rig: rig["calibration"].pop("date"), "calibration"),
        (lambda rig: rig.update(timing="sometimes"), "timing"),
        (lambda rig: rig.update(name="../rig"), "name"),
        (lambda rig: rig.update(cone=[]), "cone"),
    ],
)
def test_the_schema_finds_a_mistake_in_a_rig(
    change: Callable[[dict[str, Any]], object], place: str
) -> None:
    assert places("rig", changed(MINI, change)) == {place}


def test_the_schema_takes_a_configuration_and_finds_its_mistakes() -> None:
    assert places("service", GOOD) == set()
    content = copy.deepcopy(GOOD)
    content["trigger"]["interval_s"] = -2.0
    content["trigger"]["port"] = "5310"
    content["head"][0]["adress"] = "127.0.0.2"
    content["navigator"][0]["driver"] = "ublocks"
    content["thermometer"][0]["parity"] = "X"
    content["processing"] = {"method": "freely", "thresholds": {"sharpnes": 0.3}}
    content["watch"] = {"port": 70_000, "hosts": "all"}
    assert places("service", content) == {
        "trigger/interval_s",
        "trigger/port",
        "head/0",
        "navigator/0/driver",
        "thermometer/0/parity",
        "processing/method",
        "processing/thresholds",
        "watch/port",
        "watch/hosts",
    }


def test_the_schema_has_every_driver_with_its_settings() -> None:
    definitions = json.loads(SCHEMA_FILES["service"].read_text())["$defs"]
    for kind, drivers in registry.kinds().items():
        for driver in drivers:
            properties = definitions[f"{kind}.{driver}"]["properties"]
            for setting in registry.driver_for(kind, driver).settings():
                assert properties[setting.name]["description"] == setting.help


def test_the_schemas_are_part_of_the_package() -> None:
    root = Path(__file__).parents[3]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    for path in SCHEMA_FILES.values():
        package = path.relative_to(root).parts[0]
        patterns = project["tool"]["setuptools"]["package-data"][package]
        assert any(path in (root / package).glob(pattern) for pattern in patterns)
