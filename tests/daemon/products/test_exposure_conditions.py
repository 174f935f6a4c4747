"""What the record, the rig and the clock say about an exposure before its pixels are looked at."""

from __future__ import annotations

import datetime
import tomllib
from dataclasses import replace

import pytest

from daemon.configuration.model import PlanSection
from daemon.mission.canonical_json import RecordError
from daemon.mission.exposure import Exposure, FrameRecord, from_json
from daemon.postflight.calibration.rig_writer import rig_toml
from daemon.products.exposure_conditions import conditions_of
from daemon.products.exposure_products import report_unprocessed
from processing.quality.evaluation import evaluate
from processing.quality.figures import QualityFigures
from processing.quality.report import Flag, Verdict
from processing.rig import RigError, find_rig
from processing.rig.rig_file import rig_from_mapping

RIG = find_rig("ultracam-x-mini")
DAY_NS = 86_400 * 10**9
GPS_EPOCH = datetime.date(1980, 1, 6)


def flown_after(days: float) -> Exposure:
    calibrated_on = datetime.date.fromisoformat(RIG.calibration_date)
    return Exposure(1, mark_gps_ns=round(((calibrated_on - GPS_EPOCH).days + days) * DAY_NS))


def flags_of(exposure: Exposure, valid_days: int = 730) -> Flag:
    rig = replace(RIG, calibration_valid_days=valid_days)
    return conditions_of(exposure, rig, PlanSection(), Flag(0)).flags


@pytest.mark.parametrize(
    ("days", "valid_days", "is_expired"),
    [(10, 730, False), (730, 730, False), (731.5, 730, True), (2 * 730, 730, True), (40, 20, True)],
)
def test_an_exposure_later_than_the_calibration_is_trusted_is_flagged(
    days: float, valid_days: int, is_expired: bool
) -> None:
    flags = flags_of(flown_after(days), valid_days)
    assert bool(flags & Flag.CALIBRATION_EXPIRED) is is_expired


def test_a_flight_before_the_calibration_or_without_time_is_not_flagged() -> None:
    assert not flags_of(flown_after(-3000)) & Flag.CALIBRATION_EXPIRED
    unknown = replace(flown_after(9000), mark_gps_ns=None)
    assert not flags_of(unknown) & Flag.CALIBRATION_EXPIRED


def test_an_expired_calibration_makes_an_exposure_usable_and_states_what_to_do() -> None:
    report = evaluate(QualityFigures(), capture_flags=Flag.CALIBRATION_EXPIRED)
    (finding,) = report.findings
    assert report.verdict is Verdict.USABLE
    assert "have the camera calibrated" in finding.sentence


def test_an_exposure_that_could_not_be_processed_is_still_evaluated() -> None:
    report = report_unprocessed(RIG, flown_after(9000), Flag(0))
    assert {"NOT_PROCESSED", "CALIBRATION_EXPIRED"} <= set(report["flags"])
    assert report["verdict"] == "usable"
    assert any("process it on the ground" in f["sentence"] for f in report["findings"])


def test_how_long_a_calibration_is_trusted_goes_through_the_rig_file() -> None:
    text = rig_toml(replace(RIG, calibration_valid_days=365)).decode()
    assert rig_from_mapping(tomllib.loads(text), "rig.toml").calibration_valid_days == 365


def test_a_date_that_is_none_is_refused() -> None:
    content = tomllib.loads(rig_toml(RIG).decode())
    content["calibration"] |= {"date": "last spring", "valid_days": 0}
    with pytest.raises(RigError) as refusal:
        rig_from_mapping(content, "rig.toml")
    assert len(refusal.value.problems) == 2
    assert "YYYY-MM-DD" in str(refusal.value)


def frame(sensor: str, time_us: float | None, shifts: float | str) -> FrameRecord:
    known = from_json({"number": 1, "frames": [{"sensor": sensor}]}).frames[0]
    return replace(known, exposure_time_us=time_us, settings={"TdiShifts": shifts})


@pytest.mark.trust
def test_exposure_time_and_tdi_are_those_of_each_frame() -> None:
    frames = (frame("SU00", 4000.0, 12), frame("SU01", 2000.0, 6), frame("SU10", None, 0))
    found = conditions_of(Exposure(1, frames=frames), RIG, PlanSection(), Flag(0))
    assert found.exposure_time_s == {"SU00": 0.004, "SU01": 0.002}
    assert (found.tdi_shifts["SU00"], found.tdi_shifts["SU01"], found.tdi_shifts["SU10"]) == (
        12, 6, 0,
    )  # fmt: skip
    # A sensor without a frame is placed as those of its cone that have one.
    assert found.tdi_shifts["SU02"] == 6 and "R" not in found.tdi_shifts


@pytest.mark.trust
@pytest.mark.parametrize(("time_us", "shifts"), [(4000.0, "many"), (4000.0, -1), (-1.0, 12)])
def test_impossible_settings_of_a_head_are_an_error_of_the_exposure_and_are_evaluated(
    time_us: float, shifts: float | str
) -> None:
    exposure = Exposure(1, frames=(frame("SU00", time_us, shifts),))
    with pytest.raises(RecordError, match="SU00: "):
        conditions_of(exposure, RIG, PlanSection(), Flag(0))
    assert "NOT_PROCESSED" in report_unprocessed(RIG, exposure, Flag(0))["flags"]
