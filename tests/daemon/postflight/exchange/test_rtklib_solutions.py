"""Positions that RTKLIB computed from our observations come back through `orient`.

Debian's rnx2rtkp (2.4.3) writes no positions of event marks; RTKLIB EX does.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyproj
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.exposure import navigation_to_json
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import Message, message_of
from daemon.orientation.navigation import navigation_at
from daemon.orientation.rtklib_positions import read_positions
from daemon.orientation.trajectory import TrajectoryError, trajectory_of_samples
from daemon.postflight.exchange.rinex import RinexHeader, observation_text
from drivers.contract import NavSample
from drivers.receivers.observations import ObservationCounts
from drivers.receivers.ublox.observations import ublox_observations
from processing.rig import load_rig
from sim_hw.world.true_camera import BODY_FROM_CAMERA, projection_centre_m
from tests.daemon.orientation.test_orientation import sample_at
from tests.daemon.postflight.exchange.emulated_gnss import (
    GPS_L1,
    GPS_L2,
    WEEK_NS,
    rawx,
    sfrbx,
    subframe_words,
)
from tests.daemon.postflight.exchange.flown_block import EPOCH_NS, FLIGHT, fly

pytestmark = pytest.mark.peer

RUN = CliRunner()
ROOT = Path(__file__).parents[4]
TOE_S = (EPOCH_NS % WEEK_NS) // 7_200_000_000_000 * 7200.0
SECONDS = (3.0123457, 7.0512344, 11.0998765, 15.0501231)
ANTENNA_M = (0.4, -0.2, -1.3)
CLOCK_NS = 250_000
"""The rover's clock is fast; RTKLIB's times are corrected for it."""
IN_FLIGHT_M = (0.7, -0.9, 1.4)
"""Error of the positions in flight, north, east, up; they state 1.5 m."""
STEP_NS = 200_000_000
EPOCHS = 100
SIGNALS = (GPS_L1, GPS_L2)
to_earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
to_grid = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
METRES_PER_DEGREE = (111_200.0, 75_900.0)


class Mark(NamedTuple):
    """A position of a mark that RTKLIB wrote."""

    gps_ns: int
    words: list[str]


def antenna_at(gps_ns: int) -> tuple[float, float, float]:
    """Latitude, longitude, height."""
    pose = FLIGHT.pose(gps_ns)
    return FLIGHT.geodetic(pose.position_enu_m + pose.enu_from_body @ np.array(ANTENNA_M))


def recorded_at(gps_ns: int) -> NavSample:
    """The antenna as the receiver reports it in flight."""
    from dataclasses import replace

    latitude, longitude, height = antenna_at(gps_ns)
    north, east, up = IN_FLIGHT_M
    return replace(
        sample_at(gps_ns),
        latitude_deg=latitude + north / METRES_PER_DEGREE[0],
        longitude_deg=longitude + east / METRES_PER_DEGREE[1],
        height_m=height + up,
        horizontal_sigma_m=1.5,
        vertical_sigma_m=2.0,
    )


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    """A mission of a rover of two frequencies at 5 Hz, with an antenna above the camera."""
    folder = tmp_path_factory.mktemp("ppk")
    mission = fly(
        folder / "mission", "ultracam-l-mini", seconds=SECONDS, lens="f_number = 5.6"
    ).path
    (mission / "service.toml").write_text(
        "[plan]\nground_height_m = 395.0\n\n"
        f"[mount]\nantenna_m = {list(ANTENNA_M)}\n\n"
        '[[navigator]]\nname = "gnss"\ndriver = "ublox"\n'
    )
    (mission / "log").mkdir()
    log = FlightLog.create(mission / "log")
    noise = np.random.default_rng(2)
    samples = []
    for k in range(EPOCHS):
        # The instant of the observations, which the receiver's clock calls a full one.
        instant = EPOCH_NS + k * STEP_NS - CLOCK_NS
        samples.append(recorded_at(EPOCH_NS + k * STEP_NS))
        log.write(message_of(samples[-1]))
        at = np.array(to_earth.transform(*antenna_at(instant)))
        observed = rawx(at, instant, TOE_S, noise, signals=SIGNALS, clock_ns=CLOCK_NS)
        if k < 30:
            words = subframe_words(k + 1, EPOCH_NS, TOE_S, corrections=0)
            observed += b"".join(sfrbx(k + 1, part) for part in words)
        log.write(Message("raw/gnss", k * STEP_NS, observed))
    log.close()
    for path in sorted(mission.glob("L0/*/exposure.json")):
        content = json.loads(path.read_text())
        there = navigation_at(samples, int(content["mark_gps_ns"]))
        assert there is not None
        path.write_text(json.dumps({**content, "navigation": navigation_to_json(there)}))
    return mission


@pytest.fixture(scope="module")
def inputs(flown, tmp_path_factory) -> Path:
    """Rover, base and navigation messages in RINEX, and RTKLIB's options."""
    folder = tmp_path_factory.mktemp("rinex")
    done = RUN.invoke(app, ["export", "rinex", str(flown), "--rtklib", "--json"])
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    rover = Path(content["folder"]) / content["file"]
    shutil.copy(rover, folder / "rover.obs")
    shutil.copy(rover.with_suffix(".nav"), folder / "brdc.nav")
    # As high as the rover: signals travel in vacuum, and RTKLIB always subtracts dry air.
    latitude, longitude, height = antenna_at(EPOCH_NS + EPOCHS // 2 * STEP_NS)
    base = np.array(to_earth.transform(latitude + 0.004, longitude - 0.003, height))
    noise = np.random.default_rng(3)
    stream = b"".join(
        rawx(base, EPOCH_NS + k * STEP_NS, TOE_S, noise, signals=SIGNALS) for k in range(EPOCHS)
    )
    epochs = list(ublox_observations(stream, ObservationCounts()))
    header = RinexHeader("BASE", position_m=tuple(base))
    (folder / "base.obs").write_text(observation_text(header, epochs, [], version="3.04").text)
    (folder / "ppk.conf").write_text(
        "pos1-posmode=kinematic\npos1-frequency=l1+l2\npos1-soltype=combined\npos1-elmask=10\n"
        "pos1-ionoopt=off\npos1-tropopt=off\npos1-dynamics=on\npos1-navsys=1\n"
        "pos2-armode=continuous\npos2-arthres=3\nout-timesys=gpst\nout-timeform=hms\n"
        "out-timendec=9\nout-degform=deg\nout-height=ellipsoidal\nout-outhead=on\n"
        "ant2-postype=xyz\n" + "".join(f"ant2-pos{k}={v:.4f}\n" for k, v in enumerate(base, 1))
    )
    return folder


def computed(inputs: Path, program: str) -> Path:
    """The solution of one of both programs."""
    folder = inputs / program
    folder.mkdir(exist_ok=True)
    files = [inputs / name for name in ("rover.obs", "base.obs", "brdc.nav")]
    out = folder / "rover.pos"
    if program == "rnx2rtkp":
        if shutil.which(program) is None:
            pytest.skip("rnx2rtkp is not here; apt-get install rtklib")
        command = [program, "-k", inputs / "ppk.conf", "-o", out, *files]
    else:
        if importlib.util.find_spec("pyrtklib5") is None:
            pytest.skip("pyrtklib5 has no wheel for this processor or release of Python")
        command = [sys.executable, "-m", "tests.support.rtklib_ex", inputs / "ppk.conf", out]
        command += files
    subprocess.run(
        [str(w) for w in command], cwd=ROOT, capture_output=True, check=True, timeout=100
    )
    return out


@pytest.fixture(scope="module")
def solution(inputs) -> Path:
    return computed(inputs, "rtklib-ex")


def marks_of(path: Path) -> list[Mark]:
    """Rows of a file of events, read here."""
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("%")]
    day_ns = EPOCH_NS - EPOCH_NS % 86_400_000_000_000
    found = []
    for row in rows:
        hours, minutes, seconds = row[1].split(":")
        clock_ns = (int(hours) * 3600 + int(minutes) * 60) * 10**9 + round(float(seconds) * 1e9)
        found.append(Mark(day_ns + clock_ns, row))
    return found


def oriented(mission: Path, trajectory: Path) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """What the command states, and the rows of its table."""
    done = RUN.invoke(
        app,
        ["orient", str(mission), "--trajectory", str(trajectory), "--crs", "EPSG:32633", "--json"],
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    text = (Path(content["folder"]) / "orientation.csv").read_text().splitlines()
    return content, list(csv.DictReader(line for line in text if not line.startswith("#")))


@pytest.mark.parametrize("program", ["rnx2rtkp", "rtklib-ex"])
def test_orientations_by_a_solution_of_rtklib_err_as_it_states(flown, inputs, program) -> None:
    path = computed(inputs, program)
    events = path.with_name("rover_events.pos")
    assert events.exists() == (program == "rtklib-ex")
    if events.exists():
        # RINEX holds marks to 100 ns.
        stated = [mark.gps_ns - EPOCH_NS for mark in marks_of(events)]
        assert np.abs(np.array(stated) - np.array(SECONDS) * 1e9).max() <= 100
    content, rows = oriented(flown, path)
    rig = load_rig(Mission.open(flown).rig_path)
    assert content["missing"] == [] and len(rows) == 4 * len(rig.cones)
    normalized = []
    for row in rows:
        cone = rig.cone(row["cone"])
        pose = FLIGHT.pose(int(row["gps_ns"]))
        latitude, longitude, height = FLIGHT.geodetic(projection_centre_m(cone, pose))
        truth = to_grid.transform(longitude, latitude, height)
        error_m = np.array([float(row[k]) for k in ("east_m", "north_m", "height_m")]) - truth
        horizontal, vertical = (
            float(row[f"{axis}_sigma_m"]) for axis in ("horizontal", "vertical")
        )
        assert max(horizontal, vertical) < 0.04, "ambiguities are fixed"
        assert row["method"] == "interpolated" and np.abs(error_m).max() < 0.03
        normalized.append(error_m / [horizontal, horizontal, vertical])
        # Attitude is that of the flight, between samples of 5 Hz.
        up_in_camera = (pose.enu_from_body @ BODY_FROM_CAMERA)[2]
        tilts = np.cos(np.radians([float(row["omega_deg"]), float(row["phi_deg"])]))
        assert np.degrees(np.arccos(np.prod(tilts)) - np.arccos(up_in_camera[2])) == pytest.approx(
            0.0, abs=0.05
        )
    # Stated sigmas are upper limits.
    assert np.abs(normalized).max() < 3.0 and np.mean(np.square(normalized)) < 1.0
    # Forward, right, down: what the flight's own positions err by, in the camera's axes.
    heading = FLIGHT.pose(EPOCH_NS).heading_rad
    north, east, up = (-value for value in IN_FLIGHT_M)
    forward = north * np.cos(heading) + east * np.sin(heading)
    right = -north * np.sin(heading) + east * np.cos(heading)
    assert content["offset_forward_right_down_m"] == pytest.approx([forward, right, -up], abs=0.15)


def test_marks_that_rtklib_drew_across_a_gap_are_not_oriented(flown, inputs, tmp_path) -> None:
    """The rover observed nothing from 4.8 to 9.4 s; RTKLIB states a position and its accuracy."""
    for name in ("base.obs", "brdc.nav", "ppk.conf"):
        shutil.copy(inputs / name, tmp_path / name)
    kept, is_kept = [], True
    for line in (inputs / "rover.obs").read_text().splitlines():
        if line.startswith(">"):
            is_kept = line[31] == "5" or not 4.7 < float(line[18:29]) < 9.5
        if is_kept:
            kept.append(line)
    (tmp_path / "rover.obs").write_text("\n".join(kept) + "\n")
    path = computed(tmp_path, "rtklib-ex")
    assert len(marks_of(path.with_name("rover_events.pos"))) == 4
    content, _ = oriented(flown, path)
    assert {(one["exposure"], one["why"]) for one in content["missing"]} == {(2, "no navigation")}
    assert {one["image"][:6] for one in content["oriented"]} == {"000001", "000003", "000004"}


def solution_text(positions: list[tuple[float, float, float, float]], *, decimals: int = 9) -> str:
    """A `.pos` of (second, north, east, up), north and east in metres from 47 N 15 E."""
    lines = [
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,ns=# of satellites)",
        "%  GPST  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)",
    ]
    lines += [
        f"2445 {second:.{decimals}f} {47 + north / METRES_PER_DEGREE[0]:.9f} "
        f"{15 + east / METRES_PER_DEGREE[1]:.9f} {up:.4f} 1 9 0.0100 0.0100 0.0200 0 0 0 0 9"
        for second, north, east, up in positions
    ]
    return "\n".join(lines) + "\n"


def curve(second: float) -> tuple[float, float, float, float]:
    """60 m/s north, 2 m/s2 to the east and 1 m/s2 up."""
    return second, 60.0 * second, second**2, 100.0 + 0.5 * second**2


def between(a: tuple[float, ...], b: tuple[float, ...], share: float) -> Any:
    return tuple(x + share * (y - x) for x, y in zip(a, b, strict=True))


def test_an_event_on_the_straight_line_between_epochs_does_not_replace_the_curve(tmp_path) -> None:
    epochs = [curve(float(second)) for second in range(10)]
    # One epoch is missing. An event next to an epoch would spoil its velocity.
    (tmp_path / "a.pos").write_text(solution_text(epochs[:2] + epochs[3:]))
    marks = [
        between(epochs[k], epochs[k + 1], share) for k, share in ((0, 0.5), (4, 0.5), (6, 0.001))
    ]
    (tmp_path / "a_events.pos").write_text(
        solution_text(marks) + "2445 9.500000000   Q=0, Time mark is not valid\r\n"
    )
    samples = read_positions(tmp_path / "a.pos")
    assert len(samples) == 9
    trajectory = trajectory_of_samples("a", samples)
    for second in (3.5, 4.5, 6.001, 6.5):
        there = trajectory.at(2445 * WEEK_NS + round(second * 1e9))
        assert there is not None and there.height_m is not None
        _, north, east, up = curve(second)
        assert (there.latitude_deg - 47) * METRES_PER_DEGREE[0] == pytest.approx(north, abs=0.02)
        assert (there.longitude_deg - 15) * METRES_PER_DEGREE[1] == pytest.approx(east, abs=0.002)
        assert there.height_m == pytest.approx(up, abs=0.001)
    # Positions that another program computed better are used.
    (tmp_path / "a_events.pos").write_text(solution_text([curve(4.5)]))
    assert len(read_positions(tmp_path / "a.pos")) == 10


def test_events_of_another_solution_are_refused(tmp_path) -> None:
    (tmp_path / "a.pos").write_text(solution_text([curve(0.2 * s) for s in range(50)]))
    second, north, east, up = curve(4.5)
    for shifted in ((second, north, east + 1.2, up), (second, north, east, up - 1.8)):
        (tmp_path / "a_events.pos").write_text(solution_text([shifted]))
        with pytest.raises(TrajectoryError, match=r"a_events\.pos: the mark .* must be of one"):
            read_positions(tmp_path / "a.pos")


def test_times_of_few_decimals_are_in_the_sigma(tmp_path) -> None:
    epochs = [curve(second * 0.25) for second in range(10)]
    event = (0.625, *between(epochs[2], epochs[3], 0.5016)[1:])
    (tmp_path / "a_events.pos").write_text(solution_text([event], decimals=3))
    for decimals, sigma_m in ((9, 0.0100), (3, 0.0200), (2, 0.1735)):
        path = tmp_path / "a.pos"
        path.write_text(solution_text(epochs, decimals=decimals))
        samples = read_positions(path)
        assert len(samples) == 10
        assert samples[5].horizontal_sigma_m == pytest.approx(sigma_m, abs=0.0002), decimals


def shifted(text: str, seconds: int) -> str:
    """With times that are so many seconds less; all are of one hour."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("%"):
            clock = line[11:19]
            whole = sum(int(p) * f for p, f in zip(clock.split(":"), (3600, 60, 1), strict=True))
            whole -= seconds
            line = (
                f"{line[:11]}{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}{line[19:]}"
            )
        lines.append(line)
    return "\n".join(lines) + "\n"


def with_columns(text: str, change) -> str:
    lines = []
    for line in text.splitlines():
        words = line.split()
        lines.append(line if line.startswith("%") else " ".join(change(words)))
    return "\n".join(lines) + "\n"


WRONG = {
    "UTC": (lambda t: shifted(t, 18), "times are 18 s too early, the leap seconds of UTC"),
    "late": (lambda t: shifted(t, -7), "times are 7 s too late"),
    "exchanged": (
        lambda t: with_columns(t, lambda w: [*w[:2], w[3], w[2], *w[4:]]),
        "if latitude and longitude are exchanged",
    ),
    "south": (
        lambda t: with_columns(t, lambda w: [*w[:2], f"-{w[2]}", *w[3:]]),
        "if the latitude has the other sign",
    ),
    "geoid": (
        lambda t: with_columns(t, lambda w: [*w[:4], f"{float(w[4]) - 45.2:.4f}", *w[5:]]),
        r"heights are -4\d\.\d m from .* above the geoid",
    ),
    "elsewhere": (
        lambda t: with_columns(t, lambda w: [*w[:2], f"{float(w[2]) + 0.1:.9f}", *w[3:]]),
        r"11\.1 km from .* of another flight",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_solution_that_is_not_of_this_flight_is_refused(flown, solution, tmp_path, wrong) -> None:
    change, sentence = WRONG[wrong]
    path = tmp_path / "rover.pos"
    path.write_text(change(solution.read_text()))
    done = RUN.invoke(app, ["orient", str(flown), "--trajectory", str(path)])
    assert done.exit_code != 0
    with pytest.raises(TrajectoryError, match=sentence):
        raise done.exception or AssertionError(done.output)


def test_half_a_solution_names_the_exposures_without_navigation(flown, solution, tmp_path) -> None:
    lines = solution.read_text().splitlines()
    path = tmp_path / "rover.pos"
    path.write_text("\n".join(lines[: len(lines) // 2]) + "\n")
    content, _ = oriented(flown, path)
    assert {one["exposure"] for one in content["missing"]} == {3, 4}
    done = RUN.invoke(app, ["orient", str(flown), "--trajectory", str(path)])
    assert "000003 RGB: not oriented, no navigation" in " ".join(done.output.split())


def test_another_antenna_is_stated_in_the_axes_of_the_camera(flown, solution, tmp_path) -> None:
    """1.1 m above the one of the mount; in flight positions err by metres, so it is no error."""
    path = tmp_path / "rover.pos"
    path.write_text(
        with_columns(solution.read_text(), lambda w: [*w[:4], f"{float(w[4]) + 1.1:.4f}", *w[5:]])
    )
    whole, _ = oriented(flown, solution)
    content, _ = oriented(flown, path)
    assert np.subtract(
        content["offset_forward_right_down_m"], whole["offset_forward_right_down_m"]
    ) == pytest.approx([0.0, 0.0, -1.1], abs=0.06)
    done = RUN.invoke(app, ["orient", str(flown), "--trajectory", str(path)])
    assert "Median of the differences in the camera's axes: forward" in done.output
