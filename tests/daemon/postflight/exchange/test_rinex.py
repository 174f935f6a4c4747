"""Recorded observations become RINEX for RTKLIB and georinex, and come back as a trajectory."""

from __future__ import annotations

import binascii
import csv
import json
import shutil
import struct
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pyproj
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.mission.log.log_records import Message, message_of
from daemon.orientation.rtklib_positions import read_positions
from daemon.orientation.trajectory import TrajectoryError
from daemon.postflight.exchange.rinex import RinexHeader, observation_text
from drivers.receivers.novatel.observations import novatel_observations
from drivers.receivers.observations import Observation, ObservationCounts, ObservationEpoch
from drivers.receivers.ublox.observations import ublox_observations
from tests.daemon.orientation.test_orientation import sample_at
from tests.daemon.postflight.exchange.emulated_gnss import (
    WEEK_NS,
    novatel_range,
    rawx,
    sfrbx,
    subframe_words,
)
from tests.daemon.postflight.exchange.flown_block import EPOCH_NS, FLIGHT, fly

pytestmark = pytest.mark.peer

RUN = CliRunner()
RECORDING = (
    Path(__file__).parents[5] / "shared" / "data" / "nav/gpsd-daemon/ublox-zed-f9p_hpg1.11.log"
)
START_NS = EPOCH_NS
TOE_S = (START_NS % WEEK_NS) // 7_200_000_000_000 * 7200.0
SECONDS = (5.05, 9.05, 13.05, 17.05)
EPOCHS = 200
STEP_NS = 100_000_000
to_earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")


def program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not here; apt-get install rtklib")
    return found


def run(*command: str, folder: Path) -> None:
    subprocess.run(command, cwd=folder, capture_output=True, check=True, timeout=100)


def loaded(path: Path):
    georinex = pytest.importorskip("georinex")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return georinex.load(path)


def antenna_at(gps_ns: int) -> np.ndarray:
    return np.array(to_earth.transform(*FLIGHT.geodetic(FLIGHT.pose(gps_ns).position_enu_m)))


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    """A mission whose receiver recorded RXM-RAWX at 10 Hz, with four exposures and their marks."""
    folder = tmp_path_factory.mktemp("gnss")
    mission = fly(
        folder / "mission", "ultracam-l-mini", seconds=SECONDS, lens="f_number = 5.6"
    ).path
    (mission / "service.toml").write_text(
        '[plan]\nground_height_m = 395.0\n\n[[navigator]]\nname = "gnss"\ndriver = "ublox"\n'
    )
    (mission / "log").mkdir()
    log = FlightLog.create(mission / "log")
    noise = np.random.default_rng(2)
    for k in range(EPOCHS):
        instant = START_NS + k * STEP_NS
        log.write(message_of(sample_at(instant)))
        observed = rawx(antenna_at(instant), instant, TOE_S, noise)
        if k < 30:
            words = subframe_words(k + 1, START_NS, TOE_S, corrections=0)
            observed += b"".join(sfrbx(k + 1, part) for part in words)
        log.write(Message("raw/gnss", k * STEP_NS, observed))
    log.close()
    return mission


def exported(mission: Path, *more: str) -> tuple[dict, Path]:
    done = RUN.invoke(app, ["export", "rinex", str(mission), "--json", *more])
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    return content, Path(content["folder"]) / content["file"]


@pytest.mark.skipif(not RECORDING.exists(), reason="needs a recording in ../shared/data/nav")
@pytest.mark.parametrize("version", ["3.04", "4.00"])
def test_a_real_recording_gives_the_values_of_convbin(tmp_path: Path, version: str) -> None:
    # The first seconds: georinex takes a minute for the rest.
    data = RECORDING.read_bytes()[:100_000]
    (tmp_path / "f9p.ubx").write_bytes(data[data.find(b"\xb5\x62") :])
    run(
        program("convbin"), "-r", "ubx", "-v", "3.04", "-od", "-os", "-o", "theirs.obs",
        "-n", "theirs.nav", "f9p.ubx", folder=tmp_path,
    )  # fmt: skip
    counts = ObservationCounts()
    epochs = list(ublox_observations(data, counts))
    assert counts.epochs > 30 and (counts.unknown_signals, counts.unreadable) == (0, 0)
    text = observation_text(RinexHeader("F9P"), epochs, [], version=version).text
    if version == "4.00":
        # georinex reads version 3; the records of 4.00 are the same but for the version.
        assert text.startswith("     4.00")
        text = text.replace("     4.00", "     3.04", 1)
    (tmp_path / "ours.obs").write_text(text)
    ours, theirs = loaded(tmp_path / "ours.obs"), loaded(tmp_path / "theirs.obs")
    # convbin leaves out epochs at the edge of a recording that was cut.
    assert np.isin(theirs.time.values, ours.time.values).all() and len(theirs.time) > 40
    ours = ours.sel(sv=theirs.sv, time=theirs.time)
    for name in theirs.data_vars:
        a, b = ours[name].values, theirs[name].values
        known = np.isfinite(b)
        assert np.abs(a[known] - b[known]).max() == 0.0, name
        # convbin drops phases of low quality; codes, Dopplers and strengths are the same set.
        assert name.startswith("L") or (np.isfinite(a) == known).all(), name


def test_range_of_novatel_gives_the_values_of_convbin(tmp_path: Path) -> None:
    instants = [START_NS + k * 1_000_000_000 for k in range(5)]
    data = b"".join(novatel_range(antenna_at(i), i, TOE_S) for i in instants)
    (tmp_path / "oem.gps").write_bytes(data)
    run(
        program("convbin"), "-r", "nov", "-v", "3.04", "-od", "-os", "-o", "theirs.obs",
        "-n", "theirs.nav", "oem.gps", folder=tmp_path,
    )  # fmt: skip
    counts = ObservationCounts()
    epochs = list(novatel_observations(data, counts))
    assert (counts.epochs, counts.unknown_signals, counts.unreadable) == (5, 0, 0)
    text = observation_text(RinexHeader("OEM"), epochs, [], version="3.04").text
    (tmp_path / "ours.obs").write_text(text)
    ours, theirs = loaded(tmp_path / "ours.obs"), loaded(tmp_path / "theirs.obs")
    assert set(theirs.data_vars) <= set(ours.data_vars) and "C1C" in theirs.data_vars
    ours = ours.sel(sv=theirs.sv)
    for name in theirs.data_vars:
        a, b = ours[name].values, theirs[name].values
        known = np.isfinite(b)
        assert known.any() and np.abs(a[known] - b[known]).max() < 0.0011, name


def lock_flags(*seen: tuple[float, float]) -> list[str]:
    """Loss-of-lock flags of one phase by (seconds, lock time in s)."""
    epochs = [
        ObservationEpoch(
            round((1000.0 + second) * 1e9),
            (Observation("G05", "1C", 2e7, 1e8, 0.0, 45.0, lock_s),),
        )
        for second, lock_s in seen
    ]
    text = observation_text(RinexHeader("m"), epochs, [], version="3.04").text
    return [line[33:34].strip() for line in text.splitlines() if line.startswith("G05")]


def test_the_phase_after_a_gap_of_the_recording_is_marked_unless_it_was_tracked_through() -> None:
    assert lock_flags((0, 30.0), (1, 31.0), (60, 90.0), (61, 91.0)) == ["", "", "", ""]
    assert lock_flags((0, 30.0), (1, 31.0), (60, 40.0), (61, 41.0)) == ["", "", "1", ""]
    # A receiver that counts to 64.5 s only leaves it open after a longer gap.
    assert lock_flags((0, 64.5), (1, 64.5), (200, 64.5)) == ["", "", "1"]


def test_unknown_biases_of_glonass_are_blank() -> None:
    """Zeros would state that its code and phase are aligned."""
    epoch = ObservationEpoch(0, (Observation("R05", "1C", 2e7, 1e8, 0.0, 45.0, 9.0, channel=1),))
    text = observation_text(RinexHeader("m"), [epoch], [], version="3.04").text
    (line,) = (one for one in text.splitlines() if "GLONASS COD/PHS/BIS" in one)
    assert line == f"{'':60}GLONASS COD/PHS/BIS"


def test_damaged_messages_cost_themselves_only() -> None:
    good = [rawx(antenna_at(START_NS), START_NS + k * STEP_NS, TOE_S, np.random.default_rng(1))
            for k in range(3)]  # fmt: skip
    counts = ObservationCounts()
    stream = good[0] + good[1][:50] + b"$GPGGA,bad\r\n" + good[2] + b"\xb5\x62\x02\x15\x04\x00abcd"
    assert len(list(ublox_observations(stream, counts))) == 2 and counts.epochs == 2
    counts = ObservationCounts()
    short = novatel_range(antenna_at(START_NS), START_NS, TOE_S)
    assert list(novatel_observations(short[:-1] + b"\0", counts)) == []


def test_marks_are_events_of_100_ns_and_the_sidecar_keeps_nanoseconds(flown) -> None:
    content, path = exported(flown)
    assert (content["epochs"], content["marks"]) == (EPOCHS, 4)
    assert content["ephemerides"] == 30 and path.with_suffix(".nav").is_file()
    events = [
        line for line in path.read_text().splitlines() if line.startswith("> ") and line[31] == "5"
    ]
    assert len(events) == 4
    rows = list(csv.DictReader((path.parent / "marks.csv").read_text().splitlines()))
    for line, row, seconds in zip(events, rows, SECONDS, strict=True):
        mark = START_NS + round(seconds * 1e9)
        assert int(row["gps_ns"]) == mark and int(row["sigma_ns"]) == 25
        assert abs(int(row["rinex_less_mark_ns"])) <= 50
        ticks = round(float(line[19:29]) * 1e7)
        assert ticks == round((mark // 100) % 600_000_000)
    assert len(loaded(path).time) == EPOCHS


def test_version_4_02_keeps_the_nanoseconds_of_marks(flown, tmp_path: Path) -> None:
    """Five more digits of the second behind the columns of the clock offset."""
    mission = Path(shutil.copytree(flown, tmp_path / "mission"))
    record = mission / "L0/000002/exposure.json"
    content = json.loads(record.read_text())
    mark = START_NS + round(SECONDS[1] * 1e9) + 123_456_789
    content["mark_gps_ns"] = str(mark)
    record.write_text(json.dumps(content))
    _, path = exported(mission, "--version", "4.02")
    text = path.read_text()
    assert text.startswith("     4.02           OBSERVATION DATA")
    epochs = [line for line in text.splitlines() if line.startswith("> ")]
    assert all(len(line) == 62 and line[35:57].strip() == "" for line in epochs)
    events = [line for line in epochs if line[31] == "5"]
    # Columns 19 to 29 and 58 to 62: 100 ns, and picoseconds beyond them.
    found = [round(float(line[18:29]) * 1e7) * 100 + int(line[57:62]) / 1000 for line in events]
    assert mark % 60_000_000_000 in found and mark % 100 == 89
    rows = list(csv.DictReader((path.parent / "marks.csv").read_text().splitlines()))
    assert [row["rinex_less_mark_ns"] for row in rows] == ["0"] * 4
    _, coarse = exported(mission, "--version", "4.00")
    rows = list(csv.DictReader((coarse.parent / "marks.csv").read_text().splitlines()))
    assert rows[1]["rinex_less_mark_ns"] == "11"


def test_meas3ranges_of_septentrio_are_refused_by_name(flown, tmp_path: Path) -> None:
    mission = Path(shutil.copytree(flown, tmp_path / "mission"))
    text = (mission / "service.toml").read_text().replace('"ublox"', '"septentrio"')
    (mission / "service.toml").write_text(text)
    shutil.rmtree(mission / "log")
    (mission / "log").mkdir()
    log = FlightLog.create(mission / "log")
    body = struct.pack("<HHIH", 4109, 32, 1000, 2300) + bytes(18)
    block = b"$@" + struct.pack("<H", binascii.crc_hqx(body, 0)) + body
    log.write(Message("raw/gnss", 0, block))
    log.close()
    done = RUN.invoke(app, ["export", "rinex", str(mission)])
    sentence = " ".join(str(done.exception).split())
    assert done.exit_code != 0 and "recorded Meas3Ranges, whose compression is not read" in sentence
    assert "switch MeasEpoch on" in sentence


def test_two_marks_in_an_interval_are_refused_for_rtklib_only(flown, tmp_path: Path) -> None:
    mission = Path(shutil.copytree(flown, tmp_path / "mission"))
    record = mission / "L0/000002/exposure.json"
    content = json.loads(record.read_text())
    content["mark_gps_ns"] = str(START_NS + round(SECONDS[0] * 1e9) + 10_000_000)
    record.write_text(json.dumps(content))
    found, _ = exported(mission)
    assert found["intervals_with_several_marks"] == 1
    done = RUN.invoke(app, ["export", "rinex", str(mission), "--rtklib"])
    assert done.exit_code != 0 and "RTKLIB reads one" in " ".join(str(done.exception).split())


def test_what_was_not_recorded_is_named(flown, tmp_path: Path) -> None:
    mission = Path(shutil.copytree(flown, tmp_path / "mission"))
    shutil.rmtree(mission / "log")
    (mission / "log").mkdir()
    for options, sentence in (
        ([], "recorded no RXM-RAWX"),
        (["--receiver", "other"], "is no receiver whose observations are read"),
        (["--version", "2.11"], "is not written"),
    ):
        done = RUN.invoke(app, ["export", "rinex", str(mission), *options])
        assert done.exit_code != 0 and sentence in " ".join(str(done.exception).split())


def test_the_first_of_several_receivers_is_exported_with_a_sentence(
    flown, tmp_path: Path, monkeypatch
) -> None:
    mission = Path(shutil.copytree(flown, tmp_path / "mission"))
    flew = Mission.open(mission).flown_configuration()
    both = [*flew["navigator"], {"name": "spare", "driver": "novatel"}]
    monkeypatch.setattr(Mission, "flown_configuration", lambda _: {**flew, "navigator": both})
    done = RUN.invoke(app, ["export", "rinex", str(mission)])
    assert done.exit_code == 0 and "spare by --receiver" in " ".join(done.output.split())
    first = both[0]["name"]
    found, _ = exported(mission)
    assert found["other_receivers"] == ["spare"]
    found, _ = exported(mission, "--receiver", first)
    assert found["other_receivers"] == []


@pytest.fixture(scope="module")
def solution(flown, tmp_path_factory) -> Path:
    """Positions by RTKLIB, kinematic against an emulated base station, forward and backward."""
    folder = tmp_path_factory.mktemp("ppk")
    _, rover = exported(flown, "--rtklib")
    shutil.copy(rover, folder / "rover.obs")
    base = antenna_at(START_NS) + np.array([300.0, -200.0, -400.0])
    noise = np.random.default_rng(3)
    stream = b"".join(rawx(base, START_NS + k * STEP_NS, TOE_S, noise) for k in range(EPOCHS))
    epochs = list(ublox_observations(stream, ObservationCounts()))
    header = RinexHeader("BASE", position_m=tuple(base))
    (folder / "base.obs").write_text(observation_text(header, epochs, [], version="3.04").text)
    shutil.copy(rover.with_suffix(".nav"), folder / "brdc.nav")
    (folder / "ppk.conf").write_text(
        "pos1-posmode=kinematic\npos1-frequency=l1\npos1-soltype=combined\npos1-elmask=10\n"
        "pos1-ionoopt=off\npos1-tropopt=off\npos1-dynamics=on\npos1-navsys=1\n"
        "pos2-armode=continuous\npos2-arthres=2\nout-timesys=gpst\nout-timeform=hms\n"
        "out-timendec=9\nout-degform=deg\nout-height=ellipsoidal\nout-outhead=on\n"
        "ant2-postype=xyz\n" + "".join(f"ant2-pos{k}={v:.4f}\n" for k, v in enumerate(base, 1))
    )
    run(
        program("rnx2rtkp"), "-k", "ppk.conf", "-o", "rover.pos", "rover.obs", "base.obs",
        "brdc.nav", folder=folder,
    )  # fmt: skip
    return folder / "rover.pos"


def test_the_positions_of_rtklib_err_as_it_states(solution) -> None:
    samples = read_positions(solution)
    assert len(samples) >= EPOCHS - 2
    for sample in samples:
        place = (sample.latitude_deg, sample.longitude_deg, sample.height_m)
        # RTKLIB's instants are doubles: 0.1 us are 6 um of flight.
        error_m = np.array(to_earth.transform(*place)) - antenna_at(sample.gps_ns)
        assert np.linalg.norm(error_m) < 3.0 * np.hypot(
            sample.horizontal_sigma_m * np.sqrt(2.0), sample.vertical_sigma_m
        )
        assert np.linalg.norm(error_m) < 0.3, "phases without fixed ambiguities"


@pytest.mark.parametrize(("with_events", "limit_m"), [(False, 0.3), (True, 0.002)])
def test_rtklib_positions_come_back_through_orient(
    flown, solution, tmp_path: Path, with_events: bool, limit_m: float
) -> None:
    """Positions of event marks, in a file next to the solution, hold at their instants."""
    copied = shutil.copy(solution, tmp_path / "rover.pos")
    if with_events:
        lines = [line for line in solution.read_text().splitlines() if line.startswith("%")]
        for seconds in SECONDS:
            mark = START_NS + round(seconds * 1e9)
            latitude, longitude, height = FLIGHT.geodetic(FLIGHT.pose(mark).position_enu_m)
            lines.append(
                f"{mark // WEEK_NS} {mark % WEEK_NS / 1e9:.9f} {latitude:.9f} {longitude:.9f} "
                f"{height:.4f} 1 9 0.0100 0.0100 0.0200 0 0 0 0.00 9.9"
            )
        (tmp_path / "rover_events.pos").write_text("\n".join(lines) + "\n")
    solution = Path(copied)
    mission = Mission.open(flown)
    done = RUN.invoke(
        app, ["orient", str(flown), "--trajectory", str(solution), "--crs", "EPSG:32633", "--json"]
    )
    assert done.exit_code == 0, done.output + str(done.exception)
    content = json.loads(done.stdout)
    assert content["trajectory"].startswith("rover-") and content["missing"] == []
    assert content["change_m"] < 0.3 and content["change_deg"] < 0.001
    to_grid = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
    from processing.rig import load_rig
    from sim_hw.world.true_camera import projection_centre_m

    rig = load_rig(mission.rig_path)
    stitched = [one for one in content["oriented"] if "_" not in one["image"]]
    assert len(stitched) == 4
    for one, seconds in zip(stitched, SECONDS, strict=True):
        pose = FLIGHT.pose(START_NS + round(seconds * 1e9))
        latitude, longitude, height = FLIGHT.geodetic(
            projection_centre_m(rig.cone(rig.master_cone), pose)
        )
        truth = to_grid.transform(longitude, latitude, height)
        found = (one["east_m"], one["north_m"], one["height_m"])
        assert np.abs(np.subtract(found, truth)).max() < limit_m


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("GPST", "UTC", "out-timesys=gpst"),
        ("WGS84/ellipsoidal", "WGS84/geodetic", "out-height=ellipsoidal"),
        ("latitude(deg)", "x-ecef(m)", "out-solformat=llh"),
        ("%", "#", "out-outhead=on|invalid|columns"),
    ],
)
def test_positions_in_other_systems_are_refused(solution, tmp_path, old, new, sentence) -> None:
    text = solution.read_text()
    assert old in text
    (tmp_path / "other.pos").write_text(text.replace(old, new))
    with pytest.raises(TrajectoryError, match=sentence):
        read_positions(tmp_path / "other.pos")
