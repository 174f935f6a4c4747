"""Frames of our own, fed through the real kernel by v4l2-ctl, compared bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.cameras.v4l2.formats import FORMATS
from drivers.contract import FrameStatus
from tests.installed.kernel import vivid

SHAPE = (720, 1280)
SENT = 8
MODES = {
    "GREY": "GREY",
    "Y10": "Y10 ",
    "Y12": "Y12 ",
    "Y16": "Y16 ",
    "Y16_BE": "Y16 -BE",
    "SRGGB8": "RGGB",
    "SBGGR10": "BG10",
    "SGRBG12": "BA12",
    "SRGGB16": "RG16",
}
"""Formats of vivid, and what v4l2-ctl calls them."""


CASES = [*((1, name) for name in MODES), (2, "GREY"), (2, "Y12")]
"""vivid's parameter multiplanar and the format. The multi-planar way is the same for every one."""


@pytest.fixture(scope="module")
def looped(request: pytest.FixtureRequest) -> Iterator[int]:
    """vivid with an HDMI output that its HDMI input sees."""
    vivid.load(
        node_types="0x101",
        input_types="0x3",
        output_types="0x1",
        num_inputs=1,
        num_outputs=1,
        multiplanar=request.param,
    )
    for node in (0, 1):
        vivid.ctl(node, "--set-dv-bt-timings", "index=7")
    yield request.param
    vivid.unload()


@pytest.mark.parametrize(("looped", "name"), CASES, indirect=["looped"])
@pytest.mark.usefixtures("looped")
def test_frames_come_through_the_kernel_bit_for_bit(name: str, tmp_path: Path) -> None:
    form = FORMATS[name]
    rng = np.random.default_rng(7)
    sent = [vivid.frame_of_ours(rng, n, SHAPE, form.bits) for n in range(SENT)]
    wire = {"GREY": "u1", "SRGGB8": "u1", "Y16_BE": ">u2"}.get(name, "<u2")
    path = tmp_path / "frames.raw"
    path.write_bytes(b"".join(frame.astype(wire).tobytes() for frame in sent))
    size = f"width={SHAPE[1]},height={SHAPE[0]},pixelformat={MODES[name]}"
    vivid.ctl(0, f"--set-fmt-video={size}")
    vivid.ctl(1, f"--set-fmt-video-out={size}")
    with (
        vivid.feeding(path),
        vivid.Flight(
            pixel_format=name,
            width_px=SHAPE[1],
            height_px=SHAPE[0],
            controls=["loop_video=1", "osd_text_mode=2"],
        ) as flight,
    ):
        every = set(range(SENT))
        flight.wait(lambda: every <= {vivid.number_of(p) for p in flight.pictures}, "every frame")
    # While the feeder starts vivid shows a picture of its own.
    numbers = [vivid.number_of(picture) for picture in flight.pictures]
    equal = [
        bool((picture == sent[number]).all())
        for number, picture in zip(numbers, flight.pictures, strict=True)
        if number is not None
    ]
    assert len(equal) >= SENT
    different = [
        np.argwhere(picture != sent[number])[:3].tolist()
        for number, picture in zip(numbers, flight.pictures, strict=True)
        if number is not None
    ]
    assert all(equal), f"{equal.count(False)} of {len(equal)} frames differ: {different[:3]}"
    assert all(flight.behind), "nothing is written behind the pixels"
    assert {frame.status for frame in flight.frames} == {FrameStatus.COMPLETE}
    assert {(f.width_px, f.height_px, f.pixel_format) for f in flight.frames} == {
        (SHAPE[1], SHAPE[0], name)
    }
    assert vivid.descriptors() == set()
    assert vivid.mappings() == 0
