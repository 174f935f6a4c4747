"""A mission as the advisor sees it: footprints, and what speaks against an exposure."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

from daemon.disk.mission import Mission
from daemon.exposure import Exposure
from daemon.orientation.exterior import exposures_of, mount_of
from daemon.orientation.footprints import seen_from
from daemon.plan.advisor import Taken
from daemon.plan.model import Point, Specification
from processing.rig import load_rig


def taken_of(mission: Mission, specification: Specification) -> list[Taken]:
    """Every exposure that is sealed, with its footprint on level ground.

    One without position or attitude sees nothing that is known, and is left out.
    """
    rig = load_rig(mission.rig_path)
    mount, plan = mount_of(mission)
    found = []
    for exposure in exposures_of(mission).results.values():
        if exposure.navigation is None:
            continue
        corners = seen_from(rig, mount, exposure.navigation, plan.ground_height_m)
        if corners is None:
            continue
        quality = _quality(mission, exposure.number)
        why = "; ".join(_objections(exposure, quality, specification))
        places = tuple(Point(latitude, longitude) for longitude, latitude in corners)
        found.append(Taken(exposure.number, places, why))
    return found


def _objections(
    exposure: Exposure, quality: Mapping[str, Any], specification: Specification
) -> Iterator[str]:
    if exposure.state == "lost":
        yield "lost"
    if quality.get("verdict") == "refly":
        grave = [f["flag"] for f in quality.get("findings", []) if f.get("verdict") == "refly"]
        # Coverage is counted here; an image beside a gap is as good as any other.
        why = dict.fromkeys(flag for flag in grave if flag != "OVERLAP")
        if why or not grave:
            yield f"refly ({', '.join(why) or 'quality'})"
    figures = quality.get("figures", {})
    navigation = exposure.navigation
    tilt_deg = figures.get("tilt_deg")
    if tilt_deg is None and navigation is not None and navigation.roll_rad is not None:
        tilt_deg = math.degrees(math.hypot(navigation.roll_rad, navigation.pitch_rad or 0.0))
    if tilt_deg is not None and tilt_deg > specification.tilt_deg:
        yield f"tilted by {tilt_deg:.1f} deg"
    crab_deg = figures.get("crab_deg")
    if crab_deg is not None and abs(crab_deg) > specification.crab_deg:
        yield f"turned by {crab_deg:.1f} deg"
    sigma_ns = exposure.mark_sigma_ns
    if sigma_ns is not None and sigma_ns > specification.time_sigma_ns:
        yield f"time known to {sigma_ns * 1e-6:.1f} ms only"


def _quality(mission: Mission, number: int) -> Mapping[str, Any]:
    try:
        content = json.loads((mission.level2(number) / "quality.json").read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
