"""Limits of the figures that the page shows, as the flight is judged by them."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from daemon.configuration.model import ProcessingSection
from processing.quality.report import Thresholds


def limits_json(mission: str | None, specification: Mapping[str, Any]) -> dict[str, Any]:
    """Limits by figure: `most` or `least` that is judged without a finding.

    Args:
        mission: folder of the mission, whose configuration names thresholds; None before the first.
        specification: requirements of the plan; empty without a plan.

    Returns:
        Figures with the limit of the thresholds or of the plan, whichever is stricter; in the unit
        of their names. A figure without a limit is absent.

    Example:
        >>> limits_json(None, {"sun_deg": 20.0, "tilt_deg": 3.0})["tilt_deg"]
        {'most': 3.0}
    """
    one = _thresholds(mission)
    most = {
        "time_sigma_ns": (one.time_sigma_ns, specification.get("time_sigma_ns")),
        "sigma0_px": (one.sigma0_px,),
        "saturated_fraction": (one.saturated_fraction,),
        "tilt_deg": (math.degrees(one.tilt_rad), specification.get("tilt_deg")),
        "crab_deg": (math.degrees(one.crab_rad), specification.get("crab_deg")),
        "gsd_m": (specification.get("gsd_m"),),
    }
    least = {
        "tie_points_pp": one.tie_points_pp_refly,
        "forward_overlap": _least_overlap(specification),
        "sun_deg": specification.get("sun_deg"),
    }
    found = {
        name: {"most": round(min(limit for limit in given if limit is not None), 9)}
        for name, given in most.items()
        if any(limit is not None for limit in given)
    }
    return found | {
        name: {"least": round(limit, 9)} for name, limit in least.items() if limit is not None
    }


def _least_overlap(specification: Mapping[str, Any]) -> float | None:
    overlap = specification.get("forward_overlap")
    if overlap is None:
        return None
    return float(overlap) - float(specification.get("overlap_tolerance", 0.0))


def _thresholds(mission: str | None) -> Thresholds:
    """Those of the configuration that is flown; the defaults if it cannot be read."""
    try:
        content = tomllib.loads((Path(mission or "") / "service.toml").read_text("utf-8"))
        section = ProcessingSection.model_validate(content.get("processing", {}))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, ValidationError):
        return Thresholds()
    given: dict[str, Any] = dict(section.thresholds)
    return replace(Thresholds(), **given)
