"""UBX framing: every byte accounted for, and a damaged frame costs only itself."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyubx2 import ERR_IGNORE, UBX_PROTOCOL, UBXReader

from drivers.receivers.ublox.decoder import LENGTHS, UbxDecoder
from drivers.receivers.ublox.framing import UbxFramer
from tests.drivers.ubx_frames import frame, nav_att, nav_eoe, nav_timegps, tim_tm2

EXCERPTS = sorted((Path(__file__).parent / "data").glob("*.ubx"))

frames = st.builds(
    frame,
    st.sampled_from((0x01, 0x02, 0x0A, 0x0D, 0x10)),
    st.integers(0x70, 0xFF),
    st.binary(max_size=60),
)
pieces = st.lists(st.one_of(frames, st.binary(max_size=30)), max_size=12)


def _accounted(framer: UbxFramer) -> int:
    return framer.frame_bytes + framer.other_bytes + framer.bad_bytes + framer.pending


def test_text_between_frames_is_no_damage() -> None:
    framer = UbxFramer()
    text = b"$GNRMC,,V*00\r\n"
    assert framer.feed(text + nav_eoe(1) + text) == [nav_eoe(1)]
    assert (framer.other_bytes, framer.bad_bytes) == (2 * len(text), 0)


def test_a_damaged_length_does_not_swallow_the_frames_behind_it() -> None:
    damaged = bytearray(frame(0x10, 0x02, bytes(20)))
    damaged[5] = 0x10
    framer = UbxFramer(LENGTHS)
    assert framer.feed(bytes(damaged) + nav_eoe(7)) == [nav_eoe(7)], "at once, not 4 kB later"
    assert framer.bad_frames == 1


def test_a_wrong_length_of_a_known_message_is_seen_in_its_header() -> None:
    damaged = bytearray(nav_att(1, 0, 0, 0))
    damaged[4] = 33
    framer = UbxFramer(LENGTHS)
    framer.feed(bytes(damaged[:6]))
    framer.feed(b"")
    assert framer.pending == 0


@settings(deadline=None)
@given(parts=pieces, cuts=st.lists(st.integers(1, 40), min_size=1, max_size=30))
def test_how_the_bytes_are_cut_on_arrival_makes_no_difference(
    parts: list[bytes], cuts: list[int]
) -> None:
    data = b"".join(parts)
    whole_framer, cut = UbxFramer(LENGTHS), UbxFramer(LENGTHS)
    expected = whole_framer.feed(data)
    found: list[bytes] = []
    at = 0
    cut_index = 0
    while at < len(data):
        size = cuts[cut_index % len(cuts)]
        found += cut.feed(data[at : at + size])
        at += size
        cut_index += 1
    assert found == expected
    assert cut.bad_bytes == whole_framer.bad_bytes
    assert _accounted(whole_framer) == _accounted(cut) == len(data)


@given(st.binary(max_size=400))
def test_random_bytes_never_raise_and_are_all_accounted_for(data: bytes) -> None:
    framer = UbxFramer(LENGTHS)
    framer.feed(data)
    assert _accounted(framer) == len(data)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_a_mutated_message_costs_at_most_itself(data: st.DataObject) -> None:
    stream = [tim_tm2(2400, 1000 * n, 7 * n, count=n) for n in range(6)]
    victim = data.draw(st.integers(1, 4))
    damaged = bytearray(stream[victim])
    kind = data.draw(st.sampled_from(("flip", "cut", "insert")))
    at = data.draw(st.integers(0, len(damaged) - 1))
    if kind == "flip":
        damaged[at] ^= data.draw(st.integers(1, 255))
    elif kind == "cut":
        del damaged[at : at + data.draw(st.integers(1, 36))]
    else:
        damaged[at:at] = data.draw(st.binary(min_size=1, max_size=50))
    stream[victim] = bytes(damaged)
    marks = UbxDecoder("r").feed(b"".join(stream), 0)
    counts = [mark.count for mark in marks if hasattr(mark, "count")]
    assert [n for n in counts if n != victim] == [n for n in range(6) if n != victim]


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_recorded_bytes_with_damage_never_raise(data: st.DataObject) -> None:
    recorded = bytearray(data.draw(st.sampled_from(EXCERPTS)).read_bytes()[:3000])
    for _ in range(data.draw(st.integers(1, 20))):
        recorded[data.draw(st.integers(0, len(recorded) - 1))] = data.draw(st.integers(0, 255))
    UbxDecoder("r").feed(bytes(recorded), 0)


@settings(max_examples=200, deadline=None)
@given(
    identity=st.sampled_from(sorted(LENGTHS)),
    data=st.data(),
)
def test_any_payload_with_a_right_checksum_never_raises(
    identity: tuple[int, int], data: st.DataObject
) -> None:
    size = LENGTHS[identity]
    payload = data.draw(st.binary(min_size=size, max_size=size))
    decoder = UbxDecoder("r")
    decoder.feed(nav_timegps(1000, 0, 2400), 0)
    decoder.feed(frame(*identity, payload), 0)


@pytest.mark.parametrize("path", EXCERPTS, ids=lambda path: path.stem)
def test_recorded_frames_are_those_that_pyubx2_finds(path: Path) -> None:
    recorded = path.read_bytes()
    reader = UBXReader(io.BytesIO(recorded), protfilter=UBX_PROTOCOL, quitonerror=ERR_IGNORE)
    theirs = [raw for raw, _ in reader if raw is not None]
    framer = UbxFramer(LENGTHS)
    assert framer.feed(recorded) == theirs
    assert framer.bad_frames == 0


@pytest.mark.parametrize(("size", "is_one"), [(8192, True), (8193, False)])
def test_a_payload_is_at_most_8192_bytes(size: int, is_one: bool) -> None:
    framer = UbxFramer()
    assert len(framer.feed(frame(0x10, 0x02, bytes(size)))) == is_one
    assert (framer.frames, framer.frame_bytes) == ((1, size + 8) if is_one else (0, 0))


def test_every_class_of_a_receiver_is_one_and_no_other() -> None:
    classes = [c for c in range(256) if UbxFramer().feed(frame(c, 0x70, b"x"))]
    assert classes == [
        *(0x01, 0x02, 0x04, 0x05, 0x06, 0x09, 0x0A, 0x0B, 0x0D, 0x10, 0x13, 0x21, 0x27, 0x28, 0x29)
    ]


def test_bytes_are_counted_by_what_they_were() -> None:
    framer = UbxFramer()
    assert framer.feed(b"ab\x80" + nav_eoe(1) + b"\xb5\x62\xff" + nav_eoe(2) + b"\xb5") == [
        *(nav_eoe(1), nav_eoe(2))
    ]
    size = len(nav_eoe(1))
    assert (framer.frames, framer.frame_bytes, framer.bad_frames) == (2, 2 * size, 0)
    # Of the sync without a frame 0x62 is printable.
    assert (framer.other_bytes, framer.bad_bytes, framer.pending) == (3, 3, 1)
    framer.reset()
    assert (framer.bad_bytes, framer.pending) == (4, 0)
