"""Files of a new rig: they are read back, the heads look where the arrangement states, all or
none."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.configuration.model import ConfigurationError
from daemon.initialization import new_configuration
from daemon.initialization.answers import Answers, Arrangement
from daemon.initialization.new_configuration import (
    ExistingConfigurationError,
    write_configuration,
)
from daemon.initialization.provisional import assumptions
from daemon.initialization.rig_text import rig_text, sensor_names
from daemon.initialization.service_text import TriggerUnit, service_text
from daemon.mission.exposure import Exposure, FrameRecord, NavigationRecord
from daemon.onboard.preflight.service_file import load
from daemon.orientation.in_flight_orientation import orientation_json
from drivers.detection.port_search import DetectionResult
from drivers.detection.protocol_detection import DetectedDevice
from processing.pipelines.perspective import has_head_images
from tests.daemon.initialization.heads import head, heads

RECEIVER = DetectionResult(
    "/dev/ttyUSB0", DetectedDevice("navigator", "nmea", "NMEA 0183", "GGA"), 115_200, "N"
)
GPS_NS = 1_447_000_000_000_000_000


def answers(
    arrangement: Arrangement = Arrangement.SIDE_BY_SIDE, count: int = 2, angle: float = 30.0
) -> Answers:
    return Answers(
        "my-rig", arrangement, heads(count), [50.0] * count, [5.5] * count, angle, 120.0, 1.5
    )


def written(folder: Path, given: Answers, receivers: Any = (RECEIVER,), **changes: Any) -> Any:
    service = service_text(given, receivers, written_by="test", **changes)
    write_configuration(folder, rig_text(given, written_by="test"), service, replace=False)
    return load(folder / "service.toml")


@pytest.mark.parametrize(
    ("arrangement", "count"),
    [
        (Arrangement.SINGLE, 1),
        (Arrangement.SIDE_BY_SIDE, 2),
        (Arrangement.SIDE_BY_SIDE, 3),
        (Arrangement.FORE_AFT, 2),
        (Arrangement.NADIR_OBLIQUE, 5),
    ],
)
def test_the_files_are_those_of_an_uncalibrated_rig_of_head_images(
    arrangement: Arrangement, count: int, tmp_path: Path
) -> None:
    given = answers(arrangement, count)
    configuration, rig = written(tmp_path / "new", given)
    assert not rig.is_calibrated and has_head_images(rig)
    assert [one.sensor for one in configuration.head] == list(sensor_names(given))
    assert [s.serial for s in rig.sensors] == [one.serial for one in given.heads]
    assert all(c.lens.f_mm == 50.0 and c.sensors[0].pitch_um == 5.5 for c in rig.cones)
    assert configuration.navigator[0].settings["port"] == "/dev/ttyUSB0"
    assert configuration.trigger.interval_s == rig.frame_interval_s == 1.5
    for name, schema in (("rig.toml", "rig"), ("service.toml", "service")):
        first = (tmp_path / "new" / name).read_text().partition("\n")[0]
        assert first == f"#:schema ./{schema}.schema.json"
        assert (tmp_path / "new" / f"{schema}.schema.json").is_file()


def directions(folder: Path, given: Answers) -> dict[str, np.ndarray[Any, Any]]:
    """Where each head looks in level flight to the north: (forward, right, down), unit length."""
    configuration, rig = written(folder, given)
    navigation = NavigationRecord(
        receiver="gnss",
        gps_ns=GPS_NS,
        latitude_deg=48.0,
        longitude_deg=11.0,
        height_m=1000.0,
        roll_rad=0.0,
        pitch_rad=0.0,
        heading_rad=0.0,
    )
    frames = tuple(
        FrameRecord(sensor=s.name, file=f"{s.name}.tif", mid_exposure_gps_ns=GPS_NS)
        for s in rig.sensors
    )
    exposure = Exposure(1, mark_gps_ns=GPS_NS, frames=frames, navigation=navigation)
    found = orientation_json(exposure, rig, configuration.mount, 0.0)
    assert not found["unoriented"]
    result = {}
    for one in found["heads"]:
        ring = np.array(one["footprint"])[:4]
        longitude, latitude = ring.mean(axis=0)[:2]
        east = (longitude - 11.0) * 111_320 * math.cos(math.radians(48.0))
        north = (latitude - 48.0) * 111_195
        result[one["cone"]] = np.array([north, east, 1000.0])
    return result


def test_heads_side_by_side_look_left_and_right(tmp_path: Path) -> None:
    looks = directions(tmp_path / "a", answers(angle=30.0))
    expected = 1000.0 * math.tan(math.radians(15.0))
    assert looks["left"][1] == pytest.approx(-expected, abs=8.0)
    assert looks["right"][1] == pytest.approx(expected, abs=8.0)
    assert abs(looks["left"][0]) < 2.0 and abs(looks["right"][0]) < 2.0


def test_three_heads_side_by_side_have_the_middle_one_at_the_nadir(tmp_path: Path) -> None:
    found = directions(tmp_path / "a", answers(count=3, angle=20.0))
    looks = [found[f"head{number}"] for number in (1, 2, 3)]
    expected = 1000.0 * math.tan(math.radians(20.0))
    assert [look[1] for look in looks] == pytest.approx([-expected, 0.0, expected], abs=8.0)


def test_heads_fore_and_aft_look_to_the_front_and_back(tmp_path: Path) -> None:
    looks = directions(tmp_path / "a", answers(Arrangement.FORE_AFT, angle=30.0))
    expected = 1000.0 * math.tan(math.radians(15.0))
    assert looks["front"][0] == pytest.approx(expected, abs=8.0)
    assert looks["back"][0] == pytest.approx(-expected, abs=8.0)
    assert abs(looks["front"][1]) < 2.0 and abs(looks["back"][1]) < 2.0


def test_oblique_heads_look_to_their_sides(tmp_path: Path) -> None:
    looks = directions(tmp_path / "a", answers(Arrangement.NADIR_OBLIQUE, 5, angle=45.0))
    signs = {name: tuple(np.sign(np.round(look[:2] / 100.0))) for name, look in looks.items()}
    assert signs == {
        "nadir": (0, 0), "forward": (1, 0), "right": (0, 1), "backward": (-1, 0), "left": (0, -1),
    }  # fmt: skip


def test_a_trigger_unit_takes_the_place_of_software(tmp_path: Path) -> None:
    unit = TriggerUnit("10.0.0.9", 3957)
    configuration, _ = written(tmp_path / "a", answers(), trigger_unit=unit)
    assert configuration.trigger.driver == "pulse-bus"
    assert {one.settings["trigger_source"] for one in configuration.head} == {"line"}


def test_a_colour_head_has_three_bands(tmp_path: Path) -> None:
    given = answers(Arrangement.SINGLE, 1)
    colour = head(pixel_format="BayerRG12", filter_array="RGGB")
    _, rig = written(tmp_path / "a", replace(given, heads=[colour]))
    assert rig.cones[0].bands == ("red", "green", "blue")
    assert rig.sensors[0].colour_filter_array == "RGGB" and has_head_images(rig)


def test_existing_files_are_refused_and_unchanged(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("mine")
    given = answers()
    with pytest.raises(ExistingConfigurationError, match=r"has rig\.toml already"):
        written(tmp_path, given)
    assert [path.name for path in tmp_path.iterdir()] == ["rig.toml"]
    assert (tmp_path / "rig.toml").read_text() == "mine"


def test_replaced_files_are_kept_under_another_name(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("mine")
    given = answers()
    texts = rig_text(given, written_by="t"), service_text(given, [], written_by="t")
    for _ in range(2):
        write_configuration(tmp_path, *texts, replace=True)
    load(tmp_path / "service.toml")
    kept = sorted(path for path in tmp_path.iterdir() if "-until-" in path.name)
    assert [path.name.partition("-")[0] for path in kept] == ["rig", "rig", "service"]
    assert kept[0].read_text() == "mine"


def test_files_that_contradict_each_other_are_not_written(tmp_path: Path) -> None:
    given = answers()
    service = service_text(given, [], written_by="t").replace('"left"', '"nobody"')
    with pytest.raises(ConfigurationError):
        write_configuration(tmp_path / "a", rig_text(given, written_by="t"), service, replace=False)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses_leaves_the_old_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rig.toml").write_text("mine")
    given = answers()

    def refuse(path: Path) -> Any:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(new_configuration, "load", refuse)
    texts = rig_text(given, written_by="t"), service_text(given, [], written_by="t")
    with pytest.raises(OSError, match="No space"):
        write_configuration(tmp_path, *texts, replace=True)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"rig.toml": "mine"}


def test_ctrl_c_while_writing_takes_effect_after_all_files_are_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = answers()
    real_load = new_configuration.load

    def interrupted(path: Path) -> Any:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        return real_load(path)

    monkeypatch.setattr(new_configuration, "load", interrupted)
    texts = rig_text(given, written_by="t"), service_text(given, [], written_by="t")
    with pytest.raises(KeyboardInterrupt):
        write_configuration(tmp_path / "a", *texts, replace=False)
    load(tmp_path / "a" / "service.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_every_assumption_names_what_replaces_it() -> None:
    listed = assumptions(answers(), has_receiver=False, has_trigger_unit=False)
    assert all(all(one) for one in listed)
    named = {one.what for one in listed}
    assert {"calibration", "instant of exposure", "time and position"} <= named
    more = assumptions(answers(), has_receiver=True, has_trigger_unit=True)
    assert {one.what for one in more} < named
    cropped = replace(answers(), heads=[head(1, full_width_px=2400), head(2)])
    listed = assumptions(cropped, has_receiver=True, has_trigger_unit=True)
    assert any("width_px and height_px" in one.replaced_by for one in listed)
