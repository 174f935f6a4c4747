"""The link budget as plain data, for `syntopic check`."""

from __future__ import annotations

from typing import Any

from daemon.configuration.model import Configuration
from daemon.onboard.capture.link_settings import link_plans, plan_as_json
from processing.rig import Rig


def link_tables(configuration: Configuration, rig: Rig) -> list[dict[str, Any]]:
    """The budget of every interface with heads, as plain JSON types."""
    return [plan_as_json(plan) for plan in link_plans(configuration, rig)[0]]
