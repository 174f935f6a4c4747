"""Unpacking against bits laid one by one, as the standards draw them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.cameras.pixels import Packing, packed_nbytes, pixels_in_a_group, unpack

BITS = {
    Packing.BYTES: 8,
    Packing.WORDS: 16,
    Packing.WORDS_BIG_ENDIAN: 16,
    Packing.LSB_10: 10,
    Packing.LSB_12: 12,
    Packing.GVSP_10: 10,
    Packing.GVSP_12: 12,
    Packing.MIPI_10: 10,
    Packing.MIPI_12: 12,
    Packing.MIPI_14: 14,
}


def packed(packing: Packing, pixels: list[int]) -> bytes:
    """Pixels as they go over the wire, written from the standards' drawings, slowly."""
    if packing is Packing.BYTES:
        return bytes(pixels)
    if packing is Packing.WORDS:
        return b"".join(p.to_bytes(2, "little") for p in pixels)
    if packing is Packing.WORDS_BIG_ENDIAN:
        return b"".join(p.to_bytes(2, "big") for p in pixels)
    if packing in (Packing.LSB_10, Packing.LSB_12):
        bits = "".join(f"{p:0{BITS[packing]}b}"[::-1] for p in pixels)
        return bytes(int(bits[at : at + 8][::-1], 2) for at in range(0, len(bits), 8))
    out = bytearray()
    if packing in (Packing.GVSP_10, Packing.GVSP_12):
        low = BITS[packing] - 8
        for a, b in zip(pixels[::2], pixels[1::2], strict=True):
            mask = (1 << low) - 1
            out += bytes([a >> low, (b & mask) << 4 | (a & mask), b >> low])
        return bytes(out)
    count = pixels_in_a_group(packing)
    low = BITS[packing] - 8
    for at in range(0, len(pixels), count):
        group = pixels[at : at + count]
        last = sum((p & ((1 << low) - 1)) << (low * i) for i, p in enumerate(group))
        out += bytes(p >> low for p in group) + last.to_bytes(count * low // 8, "little")
    return bytes(out)


@pytest.mark.parametrize("packing", Packing)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_pixels_come_back_bit_for_bit(packing: Packing, data: st.DataObject) -> None:
    groups = data.draw(st.integers(1, 40))
    count = groups * pixels_in_a_group(packing)
    pixels = data.draw(
        st.lists(st.integers(0, (1 << BITS[packing]) - 1), min_size=count, max_size=count)
    )
    source = np.frombuffer(packed(packing, pixels), np.uint8)
    target = np.full(count, 0xA5A5, np.uint16)
    unpack(packing, source, target)
    assert target.tolist() == pixels


@pytest.mark.parametrize("packing", Packing)
def test_a_frame_of_many_blocks_has_no_seam(packing: Packing) -> None:
    count = 3 * (1 << 17) + 8
    rng = np.random.default_rng(4)
    pixels = rng.integers(0, 1 << BITS[packing], count, dtype=np.uint16)
    source = np.frombuffer(packed(packing, pixels.tolist()), np.uint8)
    target = np.zeros(count + 1, np.uint16)
    unpack(packing, source, target[:count])
    assert (target[:count] == pixels).all()
    assert target[count] == 0


def test_sizes_that_do_not_fit_are_refused_with_both() -> None:
    with pytest.raises(ValueError, match="8 pixels of 12p have 12 bytes; there are 11"):
        unpack(Packing.LSB_12, np.zeros(11, np.uint8), np.zeros(8, np.uint16))
    with pytest.raises(ValueError, match="6 pixels are not a multiple of 4, as 10p needs"):
        packed_nbytes(Packing.LSB_10, 6)


@pytest.mark.parametrize(
    ("name", "packing"), [("RAW10", Packing.MIPI_10), ("RAW12", Packing.MIPI_12)]
)
def test_pixels_packed_by_a_foreign_transmitter_model_come_back(
    name: str, packing: Packing
) -> None:
    """Bytes that cocotbext-mipi-csi2, a model of CSI-2 transmitters, made of random pixels."""
    recorded = json.loads((Path(__file__).parent / "data/mipi_packed.json").read_text())[name]
    source = np.frombuffer(bytes.fromhex(recorded["packed"]), np.uint8)
    target = np.zeros(len(recorded["pixels"]), np.uint16)
    unpack(packing, source, target)
    assert target.tolist() == recorded["pixels"]
