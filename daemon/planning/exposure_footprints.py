"""A mission as the advisor sees it: footprints, valid areas, and why an exposure does not count."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from daemon.configuration.model import MountSection, PlanSection
from daemon.mission.exposure import Exposure
from daemon.mission.layout import Mission
from daemon.mission.operator_decisions import (
    OperatorDecision,
    manual_verdicts,
    read_decisions,
    summary_of,
)
from daemon.orientation.exterior_orientation import mount_of, sealed_exposures
from daemon.orientation.footprints import footprint_corners
from daemon.planning.image_counts import ExposureFootprint
from daemon.planning.model import Point, Specification
from processing.quality import valid_area
from processing.quality.figures import QualityFigures
from processing.quality.figures.circumstances import GeometryFigures
from processing.quality.nominal_area import nominal_area
from processing.quality.valid_area import ValidArea
from processing.rig import Rig, load_rig

NO_FOOTPRINT = "its footprint is not known, since position or attitude are missing"


def exposure_footprints(mission: Mission, specification: Specification) -> list[ExposureFootprint]:
    """Every exposure that is sealed, with its footprint on level ground and its valid area.

    One without position or attitude sees nothing that is known: its footprint is empty. A manual
    verdict replaces the computed one.

    Raises:
        RecordError: `operator-decisions.json` is damaged.
    """
    rig = load_rig(mission.rig_path)
    mount, plan = mount_of(mission)
    manual = manual_verdicts(read_decisions(mission.path))
    return [
        _footprint_of(
            exposure,
            _quality(mission, exposure.number),
            rig,
            mount,
            plan,
            specification,
            manual.get(exposure.number),
        )
        for exposure in sealed_exposures(mission).results.values()
    ]


def rejection_of(manual: Mapping[str, Any]) -> str:
    """Why a rejected exposure does not count."""
    reason = f": {manual['reason']}" if manual.get("reason") else ""
    return f"rejected by {manual.get('by')}{reason}"


def without_valid_area(mission: Mission) -> int:
    """Of how many exposures no valid area is recorded: those not processed, or by an earlier
    version. Their images count whole, except for heads that sent no image."""
    return sum(
        valid_area.from_json(_quality(mission, one.number).get("valid_area")) is None
        for one in sealed_exposures(mission).results.values()
        if one.state != "lost"
    )


def area_and_cause(rig: Rig, area: object, missing: Sequence[str]) -> tuple[ValidArea, str]:
    """The valid area of an exposure, and what its gaps come from.

    Args:
        area: the entry `valid_area` of a quality report; where there is none, because the exposure
            is not processed or was by an earlier version, the missing heads alone decide.
        missing: sensors that gave no frame.
    """
    known = valid_area.from_json(area)
    if known is None:
        known = nominal_area(rig, missing)
    if missing:
        return known, f"no image of {', '.join(missing)}"
    gaps = [f"{1.0 - known.share(band):.0%} of {band}" for band in known.gaps]
    return known, f"no valid pixels in {', '.join(gaps)}" if gaps else ""


def _footprint_of(
    exposure: Exposure,
    quality: Mapping[str, Any],
    rig: Rig,
    mount: MountSection,
    plan: PlanSection,
    specification: Specification,
    manual: OperatorDecision | None = None,
) -> ExposureFootprint:
    why = "; ".join(_exclusion_reasons(exposure, quality, specification, manual))
    there = exposure.navigation
    corners = None if there is None else footprint_corners(rig, mount, there, plan.ground_height_m)
    if there is None or there.height_m is None or corners is None:
        return ExposureFootprint(exposure.number, (), why or NO_FOOTPRINT)
    missing = [sensor for sensor, _ in exposure.missing]
    area, cause = area_and_cause(rig, quality.get("valid_area"), missing)
    return ExposureFootprint(
        exposure.number,
        tuple(Point(latitude, longitude) for longitude, latitude in corners),
        why,
        area=area,
        gap_cause=cause,
        projection_centre=(
            Point(there.latitude_deg, there.longitude_deg),
            there.height_m - plan.ground_height_m,
        ),
    )


def _exclusion_reasons(
    exposure: Exposure,
    quality: Mapping[str, Any],
    specification: Specification,
    manual: OperatorDecision | None = None,
) -> Iterator[str]:
    if exposure.state == "lost":
        yield "lost"
    if manual is not None:
        # The decision of a person replaces what is computed; pixels that are missing stay missing.
        if manual.kind == "reject":
            yield rejection_of(summary_of(manual))
        return
    if quality.get("verdict") == "refly":
        grave = [f["flag"] for f in quality.get("findings", []) if f.get("verdict") == "refly"]
        # Coverage is counted here; an image next to a gap counts as any other.
        why = dict.fromkeys(flag for flag in grave if flag != "OVERLAP")
        if why or not grave:
            yield f"refly ({', '.join(why) or 'quality'})"
    figures = QualityFigures.from_json(quality.get("figures", {})).of(GeometryFigures)
    navigation = exposure.navigation
    tilt_deg = figures.tilt_deg
    if tilt_deg is None and navigation is not None and navigation.roll_rad is not None:
        tilt_deg = math.degrees(math.hypot(navigation.roll_rad, navigation.pitch_rad or 0.0))
    if tilt_deg is not None and tilt_deg > specification.tilt_deg:
        yield f"tilted by {tilt_deg:.1f} deg"
    crab_deg = figures.crab_deg
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
