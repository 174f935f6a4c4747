"""Presets: features of a family of heads, one file each in `presets/`.

A file has `family`, `source` (where the values come from) and a table `features`.
"""

from __future__ import annotations

import functools
import tomllib
from importlib import resources
from typing import Final

FeatureValue = bool | int | float | str
"""The value of a GenICam feature, as configurations and records hold it."""

SUFFIX: Final = ".toml"


@functools.cache
def preset_names() -> tuple[str, ...]:
    """The names of all presets.

    Returns:
        The names, sorted.
    """
    folder = resources.files("drivers.cameras.aravis").joinpath("presets")
    return tuple(
        sorted(f.name.removesuffix(SUFFIX) for f in folder.iterdir() if f.name.endswith(SUFFIX))
    )


@functools.cache
def preset_features(name: str) -> dict[str, FeatureValue]:
    """The features of a preset.

    Args:
        name: name of the preset; empty for none.

    Returns:
        Values by GenICam name, in their order; empty for an empty name.

    Raises:
        KeyError: there is no such preset.
    """
    if not name:
        return {}
    if name not in preset_names():
        raise KeyError(name)
    file = resources.files("drivers.cameras.aravis").joinpath("presets", name + SUFFIX)
    found: dict[str, FeatureValue] = tomllib.loads(file.read_text(encoding="utf-8"))["features"]
    return found
