"""Buffers of a kernel driver that lies about sizes: padded rows, short, long, with an error
flag."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras.pixels import words_at
from drivers.cameras.v4l2.formats import FORMATS
from drivers.cameras.v4l2.node import FilledBuffer, FrameLayout, VideoNode
from drivers.cameras.v4l2.v4l2_head import V4l2Head, _Session
from drivers.contract import DeviceError, FrameStatus

WIDTH, HEIGHT = 8, 3
ROW = WIDTH // 4 * 5


class Slots:
    slot_count = 1
    slot_nbytes = WIDTH * HEIGHT * 2

    def __init__(self) -> None:
        self.pixels = np.full(WIDTH * HEIGHT, 0xA5A5, np.uint16)

    def address(self, slot: int) -> int:
        return int(self.pixels.ctypes.data)


def head_of(row_nbytes: int, nbytes: int) -> tuple[V4l2Head, Slots, Any]:
    slots = Slots()
    head = V4l2Head("SU00", {"device": "/dev/video0", "pixel_format": "Y10P"}, memory=slots)
    form = FORMATS["Y10P"]
    layout = FrameLayout(WIDTH, HEIGHT, form.code, row_nbytes, nbytes)
    return head, slots, SimpleNamespace(layout=layout, format=form)


def copied(
    content: NDArray[np.uint8], *, row_nbytes: int = ROW, has_error: bool = False, offset: int = 0
) -> tuple[FrameStatus, NDArray[np.uint16]]:
    head, slots, camera = head_of(row_nbytes, max(row_nbytes, ROW) * HEIGHT)
    node = VideoNode.__new__(VideoNode)
    node._maps = [(cast(Any, bytearray(content.tobytes())), content.size)]
    camera.node = node
    session = _Session(camera, {})
    filled = FilledBuffer(0, offset, content.size, 0, has_error, None, False)
    status = head._copy(session, filled, 0)
    return status, words_at(slots.address(0), WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)


def rows(row_nbytes: int) -> NDArray[np.uint8]:
    """Rows whose pixels are 4 times the row's number, and whose padding is all ones."""
    found = np.full((HEIGHT, row_nbytes), 0xFF, np.uint8)
    for row in range(HEIGHT):
        found[row, :ROW] = [row + 1] * 4 + [0] + [row + 1] * 4 + [0]
    return found.reshape(-1)


EXPECTED = np.repeat([[4], [8], [12]], WIDTH, axis=1)


@pytest.mark.parametrize("row_nbytes", [ROW, 16, 32])
def test_padding_at_the_end_of_rows_does_not_reach_the_pixels(row_nbytes: int) -> None:
    status, pixels = copied(rows(row_nbytes), row_nbytes=row_nbytes)
    assert status is FrameStatus.COMPLETE
    assert (pixels == EXPECTED).all()


def test_the_padding_of_the_last_row_may_be_left_out() -> None:
    status, pixels = copied(rows(16)[: 2 * 16 + ROW], row_nbytes=16)
    assert status is FrameStatus.COMPLETE
    assert (pixels == EXPECTED).all()


def test_a_short_buffer_is_incomplete_and_shows_nothing_of_an_earlier_frame() -> None:
    status, pixels = copied(rows(ROW)[: ROW + 5])
    assert status is FrameStatus.INCOMPLETE
    assert (pixels[0] == 4).all()
    assert pixels[1].tolist() == [8, 8, 8, 8, 0, 0, 0, 0]
    assert (pixels[2] == 0).all()


def test_an_offset_behind_the_end_leaves_an_empty_frame() -> None:
    status, pixels = copied(rows(ROW), offset=10_000)
    assert status is FrameStatus.INCOMPLETE
    assert (pixels == 0).all()


def test_a_long_buffer_is_corrupt_and_an_error_flag_incomplete() -> None:
    assert copied(np.concatenate([rows(ROW), np.zeros(64, np.uint8)]))[0] is FrameStatus.CORRUPT
    assert copied(rows(ROW), has_error=True)[0] is FrameStatus.INCOMPLETE


def test_rows_shorter_than_their_pixels_are_refused() -> None:
    head, _slots, camera = head_of(ROW - 1, ROW * HEIGHT)
    with pytest.raises(DeviceError, match="announces 9 bytes for a row of 8 pixels Y10P"):
        head._check_size(camera)
