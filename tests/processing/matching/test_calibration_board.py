"""Boards as drawn, and their corners in emulated pictures, held against the true positions."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.board import nominal_rig
from processing.matching.board_corners import BoardCorners, find_corners, grey_picture
from processing.matching.calibration_board import BoardError, parse_board
from sim_hw.laboratory import calibration_board as simulated

CHARUCO, CHESSBOARD = "charuco:11x8:30mm:22mm", "chessboard:9x6:25mm"
RIG = nominal_rig()
TRUTH = simulated.true_heads(RIG, 1)
LEFT = RIG.cones[0]


@lru_cache(maxsize=8)
def view(text: str, index: int = 0, optics_px: float = simulated.OPTICS_PX) -> NDArray[np.uint8]:
    board = simulated.drawn_board(text)
    pose = list(simulated.board_poses(RIG, board, 1, 2 * index + 1))[-1]
    random = np.random.default_rng(index)
    return simulated.picture(TRUTH, LEFT, pose, board, random, optics_px=optics_px)


def true_corners(text: str, index: int = 0) -> dict[int, NDArray[np.float64]]:
    board = simulated.drawn_board(text)
    pose = list(simulated.board_poses(RIG, board, 1, 2 * index + 1))[-1]
    return dict(zip(*simulated.seen_corners(TRUTH, LEFT, pose, board), strict=True))


@pytest.mark.parametrize(("text", "index"), [(CHARUCO, 0), (CHARUCO, 2), (CHESSBOARD, 0)])
def test_corners_lie_where_the_head_saw_them(text: str, index: int) -> None:
    found = find_corners(parse_board(text), view(text, index))
    assert isinstance(found, BoardCorners)
    true = true_corners(text, index)
    off = np.array([px - true[k] for k, px in zip(found.index.tolist(), found.px, strict=True)])
    assert len(off) > 40
    assert float(np.sqrt(np.mean(off**2))) < 0.01
    assert float(np.abs(off).max()) < 0.04


def test_the_order_of_a_chessboard_is_that_of_the_board_and_not_of_the_picture() -> None:
    picture = view(CHESSBOARD)
    upright = find_corners(parse_board(CHESSBOARD), picture)
    turned = find_corners(parse_board(CHESSBOARD), np.ascontiguousarray(picture[::-1, ::-1]))
    assert isinstance(upright, BoardCorners) and isinstance(turned, BoardCorners)
    size = np.array(picture.shape[::-1]) - 1.0
    assert np.abs(size - turned.px - upright.px).max() < 0.02


@pytest.mark.parametrize(
    ("board", "change", "sentence"),
    [
        (CHARUCO, lambda p: p[:, ::-1], "mirrored"),
        (CHARUCO, lambda p: p * 0 + 90, "no marker"),
        ("charuco:11x8:30mm:22mm:5x5_100", None, "dictionary 4x4_1000, not 5x5_100"),
        ("charuco:9x6:30mm:22mm", None, "ends with 26: another board"),
        ("charuco:8x11:30mm:22mm", None, "not in the places of 8 x 11"),
        ("charuco:11x8:30mm:15mm", None, "markers of 0.7.. of a square"),
        ("chessboard:9x7:25mm", None, "no chessboard of 9 x 7"),
    ],
)
def test_a_picture_that_does_not_fit_the_board_is_named(
    board: str, change: object, sentence: str
) -> None:
    picture = view(CHESSBOARD if board.startswith("chess") else CHARUCO)
    if callable(change):
        picture = np.ascontiguousarray(change(picture))
    found = find_corners(parse_board(board), picture)
    assert isinstance(found, str)
    assert re.search(sentence, found), found


def test_the_layout_of_old_boards_is_named() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((11, 8), 30.0, 22.0, dictionary)
    board.setLegacyPattern(True)
    picture = board.generateImage((1100, 800), marginSize=40)
    found = find_corners(parse_board(CHARUCO), picture)
    assert isinstance(found, str) and "charuco:11x8:30mm:22mm:4x4_50:legacy" in found
    legacy = find_corners(parse_board("charuco:11x8:30mm:22mm:4x4_50:legacy"), picture)
    assert isinstance(legacy, BoardCorners) and len(legacy.index) == 70


def test_the_width_of_edges_grows_with_blur() -> None:
    sharp, blurred = (
        find_corners(parse_board(CHARUCO), view(CHARUCO, 0, optics)) for optics in (0.55, 1.6)
    )
    assert isinstance(sharp, BoardCorners) and isinstance(blurred, BoardCorners)
    assert sharp.edge_px < 2.4 < 3.2 < blurred.edge_px


def test_a_raw_picture_of_a_colour_filter_has_the_same_corners() -> None:
    grey = view(CHARUCO)
    raw = (grey.astype(np.uint16) * 16).astype(np.float64)
    raw[::2, ::2] *= 0.6
    raw[1::2, 1::2] *= 0.8
    plain = find_corners(parse_board(CHARUCO), grey_picture(grey))
    found = find_corners(parse_board(CHARUCO), grey_picture(raw.astype(np.uint16), "RGGB"))
    assert isinstance(plain, BoardCorners) and isinstance(found, BoardCorners)
    same = dict(zip(plain.index.tolist(), plain.px, strict=True))
    off = np.array(
        [p - same[k] for k, p in zip(found.index.tolist(), found.px, strict=True) if k in same]
    )
    assert len(off) > 40 and np.abs(off.mean(axis=0)).max() < 0.05


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("charuco:11x8:30:22", "has no unit"),
        ("charuco:11x8:30mm:22cm", "check the units"),
        ("charuco:11x8:30mm", "write charuco"),
        ("chessboard:9x6", "write chessboard"),
        ("chessboard:6x6:25mm", "after a quarter turn"),
        ("chessboard:9x6:25m", "outside"),
        ("chessboard:9:25mm", "COLUMNSxROWS"),
        ("charuco:11x8:30mm:22mm:9x9_50", "is none of"),
        ("charuco:20x20:30mm:22mm:4x4_50", "more than dictionary"),
        ("dots:3x3:1mm", "of no known kind"),
    ],
)
def test_a_board_that_cannot_be_is_refused_with_what_would_be_right(
    text: str, sentence: str
) -> None:
    with pytest.raises(BoardError, match=sentence):
        parse_board(text)


def test_a_board_is_the_same_after_it_was_written() -> None:
    for text in (CHARUCO, CHESSBOARD, "charuco:5x7:1in:18mm:6x6_250:legacy"):
        board = parse_board(text)
        assert parse_board(board.text) == board
    assert parse_board("chessboard:9x6:2.5cm") == parse_board(CHESSBOARD)
    assert not parse_board("chessboard:9x7:25mm").is_orientable
    assert replace(parse_board(CHARUCO), legacy=True) != parse_board(CHARUCO)
