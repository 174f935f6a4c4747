"""What of a frame is compared with its record and its rig before it is processed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daemon.mission.canonical_json import RecordError, sha256_hex
from daemon.mission.layout import Mission
from daemon.mission.store.frame_checks import tdi_shifts
from daemon.mission.store.level0 import tiff_parts
from daemon.mission.store.store import load_level0
from processing.rig import Rig, load_rig
from tests.daemon.diverging_camera import HEADS, RIG_TOML, flown_mission, frame_of

pytestmark = pytest.mark.trust
Change = Callable[[dict[str, Any]], None]


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    return flown_mission(tmp_path, [1])


def rewrite(mission: Mission, change: Change) -> None:
    """Change the record of the first exposure; `frames[0]` is that of LEFT."""
    path = mission.level0(1) / "exposure.json"
    record = json.loads(path.read_text())
    change(record)
    path.unlink()
    path.write_text(json.dumps(record))


def set_frame(**keys: object) -> Change:
    return lambda record: record["frames"][0].update(keys)


def load(mission: Mission, rig: Rig | None = None, **options: str) -> Any:
    return load_level0(mission.level0(1), rig or load_rig(mission.rig_path), **options)


def test_a_flown_exposure_fits_its_record_and_its_rig(mission: Mission) -> None:
    frames, exposure = load(mission, calibration_sha256=sha256_hex(RIG_TOML.encode()))
    assert set(frames) == set(HEADS) and exposure.state == "complete"


@pytest.mark.parametrize("at", [0, 200, 4096, -1])
def test_a_frame_altered_in_one_bit_is_refused(mission: Mission, at: int) -> None:
    path = mission.level0(1) / "LEFT.tif"
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.unlink()
    path.write_bytes(data)
    with pytest.raises(RecordError, match=r"LEFT\.tif: (was altered after|not a usable TIFF)"):
        load(mission)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (set_frame(sha256="0" * 64), "was altered after it was stored"),
        (set_frame(head_serial="S-RIGHT"), "is of head S-RIGHT; the rig has head S-LEFT there"),
        (set_frame(width_px=95), "width_px is 95 in the record; the sensor and the file have 96"),
        (set_frame(height_px=1), "height_px is 1 in the record"),
        (set_frame(pixel_format="Mono8"), "Mono8; the rig's sensor has 12 bits"),
        (set_frame(pixel_format="Mono10p"), "Mono10p; the rig's sensor has 12 bits"),
        (set_frame(pixel_format="BayerRG12"), "BayerRG12, which is RGGB; the rig's sensor has"),
        (set_frame(pixel_format="SGBRG16"), "SGBRG16, which is GBRG"),
        (set_frame(pixel_format="Mono14"), "its file has pixel_format 'Mono12'"),
        (set_frame(exposure_time_us=0), "exposure_time_us is 0; an exposure time is positive"),
        (set_frame(exposure_time_us=-4000.0), "exposure_time_us is -4000"),
        (set_frame(exposure_time_us=600e6 + 1), r"exposure_time_us is 6e\+08; an exposure time"),
        (set_frame(exposure_time_us="4000"), "a finite number is needed"),
        (set_frame(exposure_time_us=2001.0), "its file has exposure_time_us 2000.0; the record"),
        (set_frame(settings={"TdiShifts": "12"}), "TdiShifts is '12'; a whole number from 0 to 63"),
        (set_frame(settings={"TdiShifts": -1}), "TdiShifts is -1"),
        (set_frame(settings={"TdiShifts": 1.5}), "TdiShifts is 1.5"),
        (set_frame(settings={"TdiShifts": 64}), "TdiShifts is 64; a whole number from 0 to 63"),
        (set_frame(settings={"TdiShifts": 3}), "its file has TdiShifts 0; the record has 3"),
        (set_frame(device_ns="5"), "its file has device_ns '1000000000'; the record has '5'"),
        (set_frame(counter=2), "its file has counter 1; the record has 2"),
        (set_frame(file="RIGHT.tif", sha256=""), "its file has sensor 'RIGHT'"),
    ],
)
def test_what_does_not_fit_is_an_error_of_the_exposure(
    mission: Mission, change: Change, problem: str
) -> None:
    if "sensor 'RIGHT'" in problem:  # a file can be named once only
        rewrite(mission, lambda record: record["frames"].pop(1))
    rewrite(mission, change)
    with pytest.raises(RecordError, match=problem):
        load(mission)


def test_every_mismatch_of_an_exposure_is_named_at_once(mission: Mission) -> None:
    rewrite(mission, set_frame(width_px=95, settings={"TdiShifts": "x"}, sha256="0" * 64))
    with pytest.raises(RecordError) as caught:
        load(mission)
    assert len(caught.value.problems) == 4  # the hash, the size, TDI against file and against rig


def test_a_frame_of_another_exposure_is_found_though_its_hash_was_taken_over(
    tmp_path: Path,
) -> None:
    mission = flown_mission(tmp_path, [1, 2])
    other = mission.level0(2) / "LEFT.tif"
    path = mission.level0(1) / "LEFT.tif"
    path.unlink()
    path.write_bytes(other.read_bytes())
    rewrite(mission, set_frame(sha256=sha256_hex(other.read_bytes())))
    with pytest.raises(RecordError, match="its file has exposure 2; the record has 1"):
        load(mission)


def test_another_calibration_than_the_one_flown_is_refused(mission: Mission) -> None:
    with pytest.raises(RecordError, match=r"flown with calibration diverging-1, SHA-256 .*--rig"):
        load(mission, calibration_sha256="f" * 64)
    assert len(load(mission)[0]) == 2


def test_a_record_by_hand_that_leaves_everything_out_fits(mission: Mission) -> None:
    for path in mission.level0(1).glob("*.json"):
        path.unlink()
    (mission.level0(1) / "exposure.json").write_text('{"number": 1}')
    frames, exposure = load(mission, calibration_sha256="f" * 64)
    assert set(frames) == set(HEADS) and exposure.frame("LEFT").exposure_time_us is None


def test_a_frame_of_others_is_compared_by_its_size_alone(mission: Mission) -> None:
    pixels = load(mission)[0]["LEFT"]
    path = mission.level0(1) / "LEFT.tif"
    path.unlink()
    about = {"exposure": 9, "sensor": "RIGHT", "counter": 77}  # another program's words
    path.write_bytes(b"".join(bytes(part) for part in tiff_parts([pixels.copy()], about)))
    rewrite(mission, set_frame(sha256=""))
    assert (load(mission)[0]["LEFT"] == pixels).all()


def test_a_sensor_with_colour_filters_has_no_tdi(mission: Mission) -> None:
    sensor = load_rig(mission.rig_path).sensor("LEFT")
    record = replace(frame_of("LEFT", 1), settings={"TdiShifts": 2})
    assert tdi_shifts(record, sensor) == 2
    assert tdi_shifts(replace(record, settings={"TdiShifts": 2.0}), sensor) == 2
    assert tdi_shifts(replace(record, settings={}), sensor) == 0
    with pytest.raises(RecordError, match=r"LEFT: .*colour filter array has no TDI"):
        tdi_shifts(record, replace(sensor, colour_filter_array="RGGB"))
