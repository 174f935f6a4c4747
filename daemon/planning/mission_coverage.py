"""Coverage of a mission's own plan and its reflights, for the report."""

from __future__ import annotations

from typing import Any

from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import mount_of
from daemon.planning.exposure_footprints import exposure_footprints
from daemon.planning.image_size import image_on_ground_m
from daemon.planning.model import Plan
from daemon.planning.plan_readers import read_plan
from daemon.planning.reflight_planning import ReflightPlan, reflights
from daemon.planning.relief import relief_or_reason
from processing.rig import load_rig


def advice_of(mission: Mission) -> tuple[Plan, ReflightPlan, str] | None:
    """The mission's own plan, what must be flown again, and a note on the height model.

    Returns:
        None without a plan; the note is empty where there is nothing to state.

    Raises:
        DaemonError, RigError, OSError: the mission's plan, rig or configuration cannot be used.
    """
    if mission.plan_path is None:
        return None
    plan, (_, section) = read_plan(mission.plan_path), mount_of(mission)
    along_m, across_m = image_on_ground_m(load_rig(mission.rig_path), section.height_above_ground_m)
    relief, level = relief_or_reason(section)
    advice = reflights(
        plan,
        exposure_footprints(mission, plan.specification),
        image_along_m=along_m,
        image_across_m=across_m,
        relief=relief,
    )
    return plan, advice, level


def coverage_of(mission: Mission) -> dict[str, Any] | None:
    """Segments with their reasons; None without a plan.

    Raises:
        DaemonError, RigError, OSError: the mission's plan, rig or configuration cannot be used.
    """
    found = advice_of(mission)
    if found is None:
        return None
    _, advice, level = found
    return {
        "planned_km": advice.planned_m / 1000.0,
        "share": advice.covered_m / advice.planned_m if advice.planned_m else 1.0,
        "hole_ha": advice.hole_m2 / 1e4,
        "segments": advice.segments,
        "note": level,
    }
