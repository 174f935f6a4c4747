"""Why an exposure does not count, at the boundary of each figure that the project asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest

from daemon.mission.exposure import Exposure, NavigationRecord
from daemon.mission.operator_decisions import OperatorDecision
from daemon.planning.exposure_footprints import _exclusion_reasons
from daemon.planning.model import Specification

SPECIFICATION = Specification(tilt_deg=5.0, crab_deg=10.0, time_sigma_ns=1e6)


def objections(
    quality: Mapping[str, Any], manual: OperatorDecision | None = None, **changes: Any
) -> list[str]:
    return list(_exclusion_reasons(Exposure(number=1, **changes), quality, SPECIFICATION, manual))


def test_a_manual_verdict_replaces_the_computed_one_but_not_the_loss() -> None:
    about = ("anna", "operator", "2026-05-01T10:00:00Z", 1)
    rejected = OperatorDecision("reject", *about, reason="haze")
    accepted = OperatorDecision("accept", *about, reason="seen")
    computed = {"verdict": "refly", "figures": {"tilt_deg": 9.0}}
    assert objections({}, rejected) == ["rejected by anna: haze"]
    assert objections(computed, accepted) == []
    assert objections(computed) == ["refly (quality)", "tilted by 9.0 deg"]
    assert objections(computed, accepted, state="lost") == ["lost"]


@pytest.mark.parametrize(
    ("figures", "expected"),
    [
        ({}, []),
        ({"tilt_deg": 5.0}, []),
        ({"tilt_deg": 5.1}, ["tilted by 5.1 deg"]),
        ({"crab_deg": 10.0}, []),
        ({"crab_deg": -10.0}, []),
        ({"crab_deg": -10.1}, ["turned by -10.1 deg"]),
        ({"crab_deg": 10.1, "tilt_deg": 6.0}, ["tilted by 6.0 deg", "turned by 10.1 deg"]),
    ],
)
def test_tilt_and_crab_meet_the_requirement_up_to_their_limit(
    figures: dict[str, float], expected: list[str]
) -> None:
    assert objections({"figures": figures}) == expected


@pytest.mark.parametrize(
    ("sigma_ns", "expected"),
    [(None, []), (1_000_000, []), (1_500_000, ["time known to 1.5 ms only"])],
)
def test_time_meets_the_requirement_up_to_its_limit(
    sigma_ns: int | None, expected: list[str]
) -> None:
    assert objections({}, mark_sigma_ns=sigma_ns) == expected


def test_without_a_figure_the_tilt_is_that_of_roll_and_pitch() -> None:
    def tilted(roll_deg: float | None, pitch_deg: float | None) -> NavigationRecord:
        roll, pitch = (None if a is None else math.radians(a) for a in (roll_deg, pitch_deg))
        return NavigationRecord(
            receiver="gnss",
            gps_ns=0,
            method="interpolated",
            fix="3d",
            latitude_deg=47.0,
            longitude_deg=15.0,
            height_m=3000.0,
            velocity_ned_mps=(60.0, 0.0, 0.0),
            roll_rad=roll,
            pitch_rad=pitch,
            heading_rad=0.0,
        )

    assert objections({}, navigation=tilted(3.0, 4.1)) == ["tilted by 5.1 deg"]
    assert objections({}, navigation=tilted(3.0, 3.9)) == []
    assert objections({}, navigation=tilted(5.2, None)) == ["tilted by 5.2 deg"]
    assert objections({}, navigation=tilted(None, 9.0)) == []
    measured = {"figures": {"tilt_deg": 1.0}}
    assert objections(measured, navigation=tilted(9.0, 9.0)) == []


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], ["refly (quality)"]),
        ([("BLUR", "refly")], ["refly (BLUR)"]),
        ([("BLUR", "refly"), ("BLUR", "refly"), ("HAZE", "check")], ["refly (BLUR)"]),
        ([("OVERLAP", "refly")], []),
        ([("OVERLAP", "refly"), ("TILT", "refly")], ["refly (TILT)"]),
    ],
)
def test_an_image_to_refly_does_not_count_except_for_overlaps(
    flags: list[tuple[str, str]], expected: list[str]
) -> None:
    findings = [{"flag": flag, "verdict": verdict} for flag, verdict in flags]
    assert objections({"verdict": "refly", "findings": findings}) == expected
    assert objections({"verdict": "good", "findings": findings}) == []
    assert objections({}, state="lost") == ["lost"]
