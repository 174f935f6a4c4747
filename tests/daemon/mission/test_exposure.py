"""The record of an exposure, there and back, and from hostile hands."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.mission.canonical_json import RecordError, parse_record
from daemon.mission.exposure import (
    CaptureRecord,
    Exposure,
    FrameRecord,
    NavigationRecord,
    TemperatureRecord,
    capture_bytes,
    capture_from_json,
    exposure_bytes,
    from_json,
    to_json,
)
from tests.daemon.small_camera import capture_of, final_record

instants = st.none() | st.integers(-(2**63) + 1, 2**63 - 1)
counts = st.integers(0, 2**53)
numbers = st.floats(allow_nan=False, allow_infinity=False)
texts = st.text(max_size=20)
names = st.from_regex(r"[A-Z][A-Z0-9]{0,6}", fullmatch=True)
hashes = st.just("") | st.from_regex(r"[0-9a-f]{64}", fullmatch=True)
sources = st.sampled_from(["event-mark", "ptp", "interpolated", "host", "none"])

frames = st.builds(
    FrameRecord,
    sensor=names,
    head_serial=texts,
    file=st.just(""),
    sha256=hashes,
    width_px=counts,
    height_px=counts,
    pixel_format=texts,
    device_ns=instants,
    counter=st.none() | counts,
    exposure_time_us=st.none() | numbers,
    temperature_c=st.none() | numbers,
    mono_ns=st.integers(0, 2**63 - 1),
    mid_exposure_gps_ns=instants,
    time_sigma_ns=st.none() | counts,
    time_source=sources,
    settings=st.dictionaries(texts, texts | numbers | counts, max_size=3),
)
navigations = st.builds(
    NavigationRecord,
    receiver=texts,
    gps_ns=st.integers(0, 2**63 - 1),
    method=st.sampled_from(["interpolated", "extrapolated", "nearest"]),
    gap_ns=counts,
    fix=texts,
    satellites=counts,
    latitude_deg=numbers,
    longitude_deg=numbers,
    height_m=numbers,
    horizontal_sigma_m=numbers,
    vertical_sigma_m=numbers,
    velocity_ned_mps=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    speed_sigma_mps=numbers,
    roll_rad=st.none() | numbers,
    pitch_rad=st.none() | numbers,
    heading_rad=st.none() | numbers,
    leap_seconds=st.none() | st.integers(-100, 100),
)
exposures = st.builds(
    Exposure,
    number=st.integers(1, 2**53),
    trigger_sequence=counts,
    trigger_mono_ns=st.integers(0, 2**63 - 1),
    trigger_sigma_ns=counts,
    boot_id=texts,
    mark_gps_ns=instants,
    mark_sigma_ns=st.none() | counts,
    mark_source=sources,
    mark_count=st.none() | counts,
    frames=st.lists(frames, max_size=3, unique_by=lambda f: f.sensor).map(tuple),
    missing=st.lists(st.tuples(texts, texts), max_size=2).map(tuple),
    temperatures=st.lists(
        st.builds(TemperatureRecord, texts, st.none() | numbers, st.integers(-(2**53), 2**53)),
        max_size=2,
        unique_by=lambda t: t.probe,
    ).map(tuple),
    navigation=st.none() | navigations,
    line_id=texts,
    strip_id=texts,
    calibration_id=texts,
    calibration_sha256=hashes,
    configuration_sha256=hashes,
    software=texts,
    simulated=st.booleans(),
    state=st.sampled_from(["complete", "degraded", "lost"]),
    flags=st.integers(0, 2**26),
    previous_sha256=hashes,
)


@settings(max_examples=100, deadline=None)
@given(exposures)
def test_an_exposure_reads_back_as_it_was_and_writes_the_same_bytes(exposure):
    data = exposure_bytes(exposure)
    again = from_json(parse_record(data, "exposure.json"))
    assert again == exposure
    assert exposure_bytes(again) == data


def test_a_capture_reads_back_as_it_was():
    capture = capture_of(7)
    assert capture_from_json(parse_record(capture_bytes(capture), "c")) == capture


def test_instants_are_decimal_strings_and_keep_every_nanosecond():
    exposure = final_record(capture_of(3))
    content = json.loads(exposure_bytes(exposure))
    assert content["mark_gps_ns"] == "1447000003000000000"
    assert content["frames"][0]["device_ns"] == "5000000000000000003"
    assert content["temperatures"][0] == {"age_ns": 500_000_000, "probe": "0", "value_c": 32.0}


def test_a_record_by_hand_needs_only_its_number():
    exposure = from_json({"number": 4})
    assert exposure == Exposure(number=4)
    assert (exposure.state, exposure.mark_source, exposure.flags) == ("complete", "none", 0)


def test_every_mistake_is_named_at_once_with_key_value_and_cure():
    content = to_json(final_record(capture_of(3)))
    content["number"] = 0
    content["mark_gps_ns"] = 1447000003000000000
    content["frames"][1]["file"] = "../../etc/passwd"
    content["frames"][2]["exposure_time_us"] = "4000"
    content["temperatures"][0]["value"] = 3
    content["state"] = "fine"
    with pytest.raises(RecordError) as caught:
        from_json(content)
    sentences = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 6
    for part in (
        "exposure.json: number is 0; it is at least 1",
        "mark_gps_ns is 1447000003000000000; an instant is a decimal string",
        "frames[1].file is '../../etc/passwd'; letters, digits",
        "frames[2].exposure_time_us is '4000'; a finite number is needed",
        "temperatures[0].value is not a known key",
        "state is 'fine'; it is one of complete, degraded, lost",
    ):
        assert part in sentences


def test_a_sensor_named_twice_is_refused():
    content = to_json(final_record(capture_of(3)))
    content["frames"].append(content["frames"][0])
    with pytest.raises(RecordError, match="names 'SU00' twice"):
        from_json(content)
    for frame, sensor in zip(content["frames"][:2], ("A", "B"), strict=True):
        frame |= {"sensor": sensor, "file": "a.tif"}
    del content["frames"][2:]
    with pytest.raises(RecordError, match=r"names 'a\.tif' twice"):
        from_json(content)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=5,
)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_no_value_under_any_key_raises_anything_but_a_record_error(data):
    content = to_json(final_record(capture_of(3)))
    target = content
    for step in data.draw(st.sampled_from([[], ["frames", 0], ["temperatures", 0]])):
        target = target[step]
    target[data.draw(st.sampled_from(sorted(target)))] = data.draw(json_values)
    try:
        exposure = from_json(content)
    except RecordError:
        return
    exposure_bytes(exposure)


def test_the_capture_of_an_exposure_is_no_exposure():
    content = json.loads(capture_bytes(CaptureRecord(number=1)))
    with pytest.raises(RecordError, match="kind is 'capture'"):
        from_json(content)
