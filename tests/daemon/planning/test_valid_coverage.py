"""Coverage counts valid pixels: a head unplugged, frames half read, exposures lost, relief, tilt.

The brute force shares nothing with the advisor: it follows each point of a fine raster of the
ground into every image by collinearity equations of its own, and asks which sensor's rectangle of
the rig's calibration it falls on.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.exposure import Exposure, NavigationRecord, exposure_bytes
from daemon.onboard.monitoring.coverage import Coverage, advice_json
from daemon.onboard.monitoring.flight_state import FlightState
from daemon.onboard.monitoring.monitoring_process import _MissionGeometry
from daemon.onboard.service.monitoring_link import summary
from daemon.planning.model import LocalPlane, Point
from daemon.postflight.mission_report import write_report
from processing.geometry.placement import nominal_placements
from processing.geometry.topology import footprint
from processing.rig import find_rig, shipped_rigs
from tests.daemon.onboard.monitoring import flight_events as events

pytestmark = pytest.mark.trust

RIG = find_rig("ultracam-x-mini")
assert RIG.virtual_image is not None
F_MM = RIG.virtual_image.f_mm
HALF_MM = (
    RIG.virtual_image.width_px * RIG.virtual_image.pitch_mm / 2,
    RIG.virtual_image.height_px * RIG.virtual_image.pitch_mm / 2,
)
RECTANGLES = {name: footprint(one) for name, one in nominal_placements(RIG, {}, {}).items()}
PAN = [sensor.name for cone in RIG.pan_cones for sensor in cone.sensors]
HEIGHT_M, GROUND_M = 3000.0, 400.0
ALONG_M, ACROSS_M = (2 * half * HEIGHT_M / F_MM for half in reversed(HALF_MM))
BASE_M = 0.4 * ALONG_M
STATIONS = 13
LINE_M = BASE_M * (STATIONS - 1)
ORIGIN = PLANE = LocalPlane(Point(47.07, 15.43))
CELL_M = 4.0
EDGE_M = 0.5 * 0.004 * ACROSS_M
"""How well the edge of a hole is known: half a cell of an image's valid area, 1.5 m here."""


@dataclass(frozen=True)
class Short:
    """Ground that too few images see: its area, what that is known to, its first and last metre."""

    area_m2: float = 0.0
    within_m2: float = 0.0
    from_m: float = 0.0
    to_m: float = 0.0


@dataclass(frozen=True)
class Shot:
    """An exposure of the test: where and how it looked, and which parts of the image it holds."""

    number: int
    line: str
    east_m: float
    north_m: float
    attitude_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    missing: tuple[str, ...] = ()
    half_read: tuple[str, ...] = ()
    is_lost: bool = False
    extra: dict[str, Any] = field(default_factory=dict)


def line(missing: dict[int, tuple[str, ...]], **settings: Any) -> list[Shot]:
    """A line to the north; `missing` heads by station from 1."""
    return [
        Shot(k + 1, "A", 0.0, k * BASE_M, missing=missing.get(k + 1, ()), **settings)
        for k in range(STATIONS)
    ]


def holds(shot: Shot, x_mm: np.ndarray, y_mm: np.ndarray, band: str) -> np.ndarray:
    """Whether an image holds valid pixels there: by the rectangles of its sensors."""
    inside = (np.abs(x_mm) <= HALF_MM[0]) & (np.abs(y_mm) <= HALF_MM[1])
    if band != "pan":
        return inside & (band[0].upper() not in shot.missing)
    seen = np.zeros(x_mm.shape, bool)
    for name in PAN:
        if name in shot.missing:
            continue
        r = RECTANGLES[name]
        low = (r.y_min_mm + r.y_max_mm) / 2 if name in shot.half_read else r.y_min_mm
        seen |= (x_mm >= r.x_min_mm) & (x_mm <= r.x_max_mm) & (y_mm >= low) & (y_mm <= r.y_max_mm)
    return inside & seen


def images_of(shot: Shot, east: np.ndarray, north: np.ndarray, up: np.ndarray) -> tuple[Any, Any]:
    """Image coordinates, mm, x right and y forward, by collinearity."""
    roll, pitch, heading = (math.radians(a) for a in shot.attitude_deg)
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    ch, sh = math.cos(heading), math.sin(heading)
    # Aircraft axes forward, right, down in north, east, down (Rz Ry Rx).
    forward = (cp * ch, cp * sh, -sp)
    right = (sr * sp * ch - cr * sh, sr * sp * sh + cr * ch, sr * cp)
    down = (cr * sp * ch + sr * sh, cr * sp * sh - sr * ch, cr * cp)
    ned = (north - shot.north_m, east - shot.east_m, HEIGHT_M - up)
    along, across, depth = (
        sum(a * d for a, d in zip(axis, ned, strict=True)) for axis in (forward, right, down)
    )
    return F_MM * across / depth, F_MM * along / depth


def short_of(shots: list[Shot], band: str = "pan", *, relief: Any = None) -> Short:
    """By brute force: the ground of line A that fewer than two images see."""
    half = ACROSS_M * 0.35
    north, east = np.meshgrid(
        np.arange(CELL_M / 2, LINE_M, CELL_M),
        np.arange(-half + CELL_M / 2, half, CELL_M),
        indexing="ij",
    )
    up = np.zeros(north.shape) if relief is None else relief(north)
    seen = np.zeros(north.shape, int)
    for shot in shots:
        if not shot.is_lost:
            seen += holds(shot, *images_of(shot, east, north, up), band)
    bad = seen < 2
    rows = np.flatnonzero(bad.any(axis=1))
    if not len(rows):
        return Short()
    edges = [np.abs(np.diff(np.pad(bad, 1).astype(int), axis=axis)).sum() for axis in (0, 1)]
    around_m = CELL_M * sum(edges)
    area_m2 = float(bad.sum()) * CELL_M**2
    return Short(area_m2, EDGE_M * around_m, rows[0] * CELL_M, (rows[-1] + 1) * CELL_M)


def record(shot: Shot) -> Exposure:
    place = PLANE.place(shot.east_m, shot.north_m)
    roll, pitch, heading = (math.radians(a) for a in shot.attitude_deg)
    there = NavigationRecord(
        receiver="gnss",
        gps_ns=1_479_300_000_000_000_000,
        method="interpolated",
        fix="3d",
        latitude_deg=place.latitude_deg,
        longitude_deg=place.longitude_deg,
        height_m=HEIGHT_M + GROUND_M,
        horizontal_sigma_m=0.1,
        vertical_sigma_m=0.1,
        velocity_ned_mps=(60.0, 0.0, 0.0),
        speed_sigma_mps=0.1,
        roll_rad=roll,
        pitch_rad=pitch,
        heading_rad=heading,
    )
    return Exposure(
        number=shot.number,
        line_id=shot.line,
        strip_id=shot.line,
        navigation=None if shot.is_lost else there,
        missing=tuple((name, "no frame came") for name in shot.missing),
        state="lost" if shot.is_lost else "degraded" if shot.missing else "complete",
    )


def valid_area_json(shot: Shot) -> dict[str, Any]:
    """Valid area as in quality.json, from a mask of 0.2 % resolution of the test's own."""
    from processing.quality.valid_area import area_of, as_json, gap_cells, grid_of

    y, x = np.meshgrid(
        np.linspace(HALF_MM[1], -HALF_MM[1], 600), np.linspace(-HALF_MM[0], HALF_MM[0], 900),
        indexing="ij",
    )  # fmt: skip
    grid = grid_of(900, 600)
    bands = ("pan", "red", "green", "blue", "nir")
    masks = {band: holds(shot, x, y, band).astype(np.uint8) for band in bands}
    return as_json(area_of({band: gap_cells(mask, *grid) for band, mask in masks.items()}))


def mission_of(folder: Path, shots: list[Shot], *, has_area: bool = True, plan: str = "") -> Path:
    """A mission folder over one planned line."""
    ends = [PLANE.place(0.0, 0.0), PLANE.place(0.0, LINE_M)]
    geometry = {
        "type": "LineString",
        "coordinates": [[p.longitude_deg, p.latitude_deg] for p in ends],
    }
    feature = {"type": "Feature", "properties": {"id": "A", "strip": "A"}, "geometry": geometry}
    (folder / "L0").mkdir(parents=True)
    (folder / "rig.toml").write_bytes(shipped_rigs()["ultracam-x-mini"].read_bytes())
    (folder / "service.toml").write_text(
        f"[plan]\nground_height_m = {GROUND_M}\nheight_above_ground_m = {HEIGHT_M}\n{plan}"
    )
    collection = {"type": "FeatureCollection", "features": [feature]}
    (folder / "plan.geojson").write_text(json.dumps(collection))
    for shot in shots:
        (folder / f"L0/{shot.number:06d}").mkdir()
        (folder / f"L0/{shot.number:06d}/exposure.json").write_bytes(exposure_bytes(record(shot)))
        if shot.is_lost:
            continue
        (folder / f"L2/{shot.number:06d}").mkdir(parents=True)
        report = {"verdict": "usable", "findings": [], "figures": {}, **shot.extra}
        if has_area:
            report["valid_area"] = valid_area_json(shot)
        (folder / f"L2/{shot.number:06d}/quality.json").write_text(json.dumps(report))
    return folder


def advised(mission: Path, *options: str) -> dict[str, Any]:
    """What `syntopic reflights` prints."""
    done = CliRunner().invoke(app, ["reflights", str(mission), "--json", *options])
    output = json.loads(done.stdout)
    assert done.exit_code == (1 if output["segments"] else 0), done.output
    return dict(output)


def assert_the_hole(output: dict[str, Any], expected: Short) -> None:
    """Area, and stations just before and behind the hole."""
    assert output["hole_m2"] == pytest.approx(expected.area_m2, abs=expected.within_m2)
    (segment,) = output["segments"]
    margin = (expected.from_m - segment["from_m"], segment["to_m"] - expected.to_m)
    assert min(margin) > -2 * CELL_M
    assert max(margin) <= BASE_M + 2 * CELL_M


@pytest.mark.parametrize("has_area", [True, False], ids=["recorded", "earlier version"])
@pytest.mark.parametrize("head", ["SU00", "SU20"])
def test_a_head_unplugged_over_five_exposures_leaves_its_hole(
    tmp_path: Path, head: str, has_area: bool
) -> None:
    shots = line(dict.fromkeys(range(5, 10), (head,)))
    expected = short_of(shots)
    assert expected.area_m2 > 1e4
    output = advised(mission_of(tmp_path, shots, has_area=has_area))
    assert_the_hole(output, expected)
    (segment,) = output["segments"]
    assert segment["reasons"] == [f"exposures 5 to 9: no image of {head}"]
    assert {band for hole in segment["holes"] for band in hole["bands"]} == {"pan"}
    assert len(output["notes"]) == (0 if has_area else 1)


def test_what_is_advised_closes_the_hole_and_less_does_not(tmp_path: Path) -> None:
    shots = line(dict.fromkeys(range(5, 10), ("SU00",)))
    (segment,) = advised(mission_of(tmp_path / "a", shots))["segments"]
    first, last = round(segment["from_m"] / BASE_M), round(segment["to_m"] / BASE_M)
    again = [Shot(100 + k, "A", 0.0, k * BASE_M) for k in range(first, last + 1)]
    assert short_of(shots + again).area_m2 == 0.0
    output = advised(mission_of(tmp_path / "b", shots + again))
    assert (output["segments"], output["hole_m2"]) == ([], 0)
    assert short_of(shots + again[2:]).area_m2 > 0.0
    assert short_of(shots + again[:-2]).area_m2 > 0.0


def test_a_colour_head_unplugged_is_a_hole_of_its_bands_alone(tmp_path: Path) -> None:
    shots = line(dict.fromkeys(range(4, 8), ("R",)))
    assert short_of(shots, "pan").area_m2 == 0.0
    output = advised(mission_of(tmp_path, shots))
    assert_the_hole(output, short_of(shots, "red"))
    (hole,) = output["segments"][0]["holes"]
    assert (hole["bands"], hole["images"], hole["needed"]) == (["red"], 0, 2)


def test_a_head_missing_once_or_in_two_images_far_apart_is_covered_by_the_others(
    tmp_path: Path,
) -> None:
    """At 60 % every point is seen twice at least, by half of the images three times."""
    shots = line({3: ("SU30",), 9: ("SU30",)})
    expected = short_of(shots)
    output = advised(mission_of(tmp_path, shots))
    assert output["hole_m2"] == pytest.approx(expected.area_m2, abs=expected.within_m2)
    assert bool(output["segments"]) == (expected.area_m2 > 0)


def test_frames_half_read_leave_half_a_hole(tmp_path: Path) -> None:
    shots = [
        replace(one, half_read=("SU00", "SU01") if 5 <= one.number <= 8 else ()) for one in line({})
    ]
    expected = short_of(shots)
    assert expected.area_m2 > 1e4
    output = advised(mission_of(tmp_path, shots))
    assert_the_hole(output, expected)
    (reason,) = output["segments"][0]["reasons"]
    match = re.fullmatch(r"exposures 5 to 8: no valid pixels in (\d+)% of pan", reason)
    assert match is not None
    # Half of two of the heads that make the image.
    assert 5 <= int(match[1]) <= 50, reason


def test_a_lost_exposure_is_named_and_its_hole_found(tmp_path: Path) -> None:
    shots = [replace(one, is_lost=one.number == 6) for one in line({})]
    output = advised(mission_of(tmp_path, shots))
    assert_the_hole(output, short_of(shots))
    assert output["segments"][0]["reasons"] == ["exposure 6: lost"]
    assert output["segments"][0]["holes"][0]["bands"] == []


def test_crab_and_tilt_move_the_hole_as_the_image_does(tmp_path: Path) -> None:
    attitudes = [(2.5, -1.5, 7.0), (-2.0, 2.0, -6.0), (1.0, 0.5, 8.0)]
    shots = [
        replace(one, attitude_deg=attitudes[one.number % 3])
        for one in line(dict.fromkeys(range(5, 10), ("SU00",)))
    ]
    expected = short_of(shots)
    straight = short_of([replace(one, attitude_deg=(0.0, 0.0, 0.0)) for one in shots])
    assert abs(expected.area_m2 - straight.area_m2) > 2 * straight.within_m2
    output = advised(mission_of(tmp_path, shots))
    assert output["hole_m2"] == pytest.approx(expected.area_m2, abs=expected.within_m2)


def test_relief_is_followed_where_a_height_model_is_configured(tmp_path: Path) -> None:
    """A ridge of 250 m: images see less of it, and the hole changes by more than the tolerance."""
    from daemon.orientation.georeference import Georeference

    middle = PLANE.place(0.0, LINE_M / 2)
    crs = "EPSG:32633"
    system = Georeference(crs)
    there = system.place(middle.latitude_deg, middle.longitude_deg, GROUND_M)
    step, count = 25.0, 200
    offset = (np.arange(count) - count / 2) * step

    def ridge(along_m: np.ndarray) -> np.ndarray:
        return 250.0 * np.exp(-(((along_m - LINE_M / 2) / 500.0) ** 2))

    heights = np.repeat(ridge(LINE_M / 2 - offset)[:, None], count, axis=1) + GROUND_M
    corner = (there.east_m + offset[0], there.north_m - offset[-1])
    rows = "\n".join(" ".join(f"{z:.2f}" for z in row) for row in heights)
    model = tmp_path / "dem.asc"
    model.write_text(
        f"ncols {count}\nnrows {count}\nxllcenter {corner[0]}\nyllcenter {corner[1]}\n"
        f"cellsize {step}\nNODATA_value -9999\n{rows}\n"
    )
    shots = line(dict.fromkeys(range(5, 10), ("SU00",)))
    expected = short_of(shots, relief=ridge)
    level = short_of(shots)
    assert abs(expected.area_m2 - level.area_m2) > 2 * level.within_m2
    relative = f'elevation = "../dem.asc"\nelevation_crs = "{crs}"\n'
    mission = mission_of(tmp_path / "r", shots, plan=relative)
    (note,) = advised(mission)["notes"]  # a mission's name leads out of its folder by no ".."
    assert note.startswith("Level ground is assumed: ")
    output = advised(mission, "--elevation", str(model))
    assert output["hole_m2"] == pytest.approx(expected.area_m2, abs=expected.within_m2)
    shutil.copy(model, mission)
    output = advised(mission)
    assert output["hole_m2"] == pytest.approx(expected.area_m2, abs=expected.within_m2)
    settings = f'elevation = "{tmp_path}/dem.asc"\nelevation_crs = "{crs}"\n'
    output = advised(mission_of(tmp_path / "a", shots, plan=settings))
    assert output["hole_m2"] == pytest.approx(expected.area_m2, abs=expected.within_m2)
    assert output["notes"] == []
    gone = settings.replace("dem.asc", "gone.asc")
    output = advised(mission_of(tmp_path / "b", shots, plan=gone))
    assert output["hole_m2"] == pytest.approx(level.area_m2, abs=level.within_m2)
    (note,) = output["notes"]
    assert note.startswith("Level ground is assumed: ") and "gone.asc" in note


def test_in_flight_the_hole_is_known_while_it_is_flown_and_only_what_is_behind(
    tmp_path: Path,
) -> None:
    """Before the exposures are judged their missing heads count, then their valid areas."""
    shots = line(dict.fromkeys(range(4, 9), ("SU00",)))
    mission = mission_of(tmp_path, [])
    ground = _MissionGeometry()
    state = FlightState("syntopic", ground.footprint_corners)
    ground.state = state
    state.apply(events.mission(str(mission)))
    coverage = Coverage(state)
    for shot in shots:
        state.apply({"event": "sealed", **summary(record(shot))})
        if shot.number % 2:
            report = {"verdict": "usable", "valid_area": valid_area_json(shot)}
            output = {"event": "processed", "number": shot.number, "report": report}
            state.apply({**output, "duration_s": 0.5})
        advice_task = coverage.advice_task()
        assert advice_task is not None
        advice = advice_json(advice_task(), coverage)
        holes = [one for one in advice["segments"] if one["kind"] == "hole"]
        # What the planned images to come will see is no hole yet.
        to_come = [Shot(99, "A", 0.0, k * BASE_M) for k in range(shot.number, STATIONS)]
        expected = short_of(shots[: shot.number] + to_come)
        assert advice["hole_m2"] == pytest.approx(expected.area_m2, abs=expected.within_m2)
        assert bool(holes) == (expected.area_m2 > 0)
        if shot.number < STATIONS:
            assert [one["kind"] for one in advice["segments"]][-1] == "to fly"
    assert holes[0]["reasons"] == ["exposures 4 to 8: no image of SU00"]
    assert all(len(ring) == 4 for hole in holes[0]["holes"] for ring in hole["rings"])


def test_the_report_lists_and_draws_the_hole(tmp_path: Path) -> None:
    mission = mission_of(tmp_path, line(dict.fromkeys(range(5, 10), ("SU00",))))
    page = write_report(mission).path.read_text()
    output = advised(mission)
    assert f"too few images see {output['hole_m2'] / 1e4:.2f} ha" in page
    assert "exposures 5 to 9: no image of SU00" in page
    drawn = sum(len(hole["rings"]) for hole in output["segments"][0]["holes"])
    assert page.count('<polygon class="hole"') == drawn > 0
