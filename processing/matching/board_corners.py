"""Inner corners of a calibration board in a picture, and why there are none.

OpenCV finds the corners; here they are checked against the board as drawn, put into one order that
depends on the board alone, and their sharpness is measured.

Source: OpenCV, objdetect, `CharucoDetector`, `findChessboardCornersSB`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.matching.calibration_board import (
    DICTIONARIES,
    CalibrationBoard,
    charuco_detector,
)
from processing.matching.corner_fit import fitted_corners

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Picture = NDArray[np.uint8]

MIN_CORNERS: Final = 8
MARKER_TOLERANCE: Final = 0.03
"""Share by which a marker may differ from the size stated, against the square."""
_MARKER_SHRINKS_PX: Final = 3.0
_MISFIT_SQUARES: Final = 0.12
"""Distance of a corner from its place on the plane board, in squares; distortion bends less."""


@dataclass(frozen=True)
class BoardCorners:
    """Corners of one picture.

    `index` (n,) are places in `CalibrationBoard.corners_m`, `px` (n, 2) columns and rows.
    `edge_px` is the median width of edges from 10 to 90 % of contrast.
    """

    index: Indices
    px: Array
    edge_px: float


def grey_picture(pixels: NDArray[Any], colour_filter_array: str = "none") -> Picture:
    """A picture as 8-bit grey values from its 0.1th to its 99.9th percentile.

    Args:
        pixels: (height, width) or (height, width, channels), any unsigned type; channels in
            OpenCV's order.
        colour_filter_array: of a raw picture of one channel; "none" without one.

    Returns:
        Grey values, shape (height, width).
    """
    if pixels.ndim == 3:
        grey = pixels[..., :3].mean(axis=2) if pixels.shape[2] >= 3 else pixels[..., 0]
    elif colour_filter_array != "none":
        code = getattr(cv2, f"COLOR_Bayer{colour_filter_array}2GRAY")
        grey = cv2.cvtColor(np.ascontiguousarray(pixels), code)
    else:
        grey = pixels
    values = np.asarray(grey, np.float32)
    low, high = np.percentile(values[::4, ::4], [0.1, 99.9])
    scaled = (values - low) * (255.0 / max(float(high - low), 1.0))
    return np.asarray(np.clip(scaled + 0.5, 0, 255), np.uint8)


def find_corners(board: CalibrationBoard, picture: Picture) -> BoardCorners | str:
    """Find the corners of a board in one picture.

    Args:
        board: as drawn.
        picture: grey values, shape (height, width).

    Returns:
        Eight corners or more, not all in one row; or a sentence that states why there are none.
    """
    found = _charuco(board, picture) if board.kind == "charuco" else _chessboard(board, picture)
    if isinstance(found, str):
        return found
    index, px = found
    rows = np.unique(index // board.corner_columns)
    columns = np.unique(index % board.corner_columns)
    if len(index) < MIN_CORNERS or min(len(rows), len(columns)) < 2:
        return f"shows {len(index)} corners of the board; {MIN_CORNERS} or more are needed"
    misfit = _misfit_squares(board, index, px)
    if misfit > _MISFIT_SQUARES:
        return (
            f"shows corners that lie up to {misfit:.2f} squares off a board of {board.text}: "
            "another "
            "board, or a bent one"
        )
    fitted, width_px = fitted_corners(picture, px, _sides_px(board, index, px), _clear_share(board))
    accepted = np.isfinite(fitted).all(axis=1)
    if accepted.sum() < MIN_CORNERS:
        return f"shows {len(index)} corners, of which {accepted.sum()} are sharp enough to measure"
    return BoardCorners(index[accepted], fitted[accepted], float(np.median(width_px[accepted])))


def _clear_share(board: CalibrationBoard) -> float:
    """Share of a square's side between an edge and the marker in the square."""
    if board.kind == "chessboard":
        return 0.45
    return 0.45 * (1.0 - board.marker_mm / board.square_mm)


def _sides_px(board: CalibrationBoard, index: Indices, px: Array) -> Array:
    """Sides of the square to the right and below each corner, (n, 2, 2) px, by a homography."""
    plane = _plane_mm(board, index)
    homography, _ = cv2.findHomography(plane, px)
    side = board.square_mm * np.array([[1.0, 0.0], [0.0, -1.0]])
    ends = (plane[:, None] + 0.5 * side).reshape(1, -1, 2)
    starts = (plane[:, None] - 0.5 * side).reshape(1, -1, 2)
    both = [cv2.perspectiveTransform(p, homography).reshape(-1, 2, 2) for p in (starts, ends)]
    return np.asarray(both[1] - both[0])


def _charuco(board: CalibrationBoard, picture: Picture) -> tuple[Indices, Array] | str:
    detector = charuco_detector(board)
    corners, index, markers, marker_ids = detector.detectBoard(picture)
    count = 0 if marker_ids is None else len(marker_ids)
    is_short = index is None or len(index) < MIN_CORNERS
    # Some markers resemble others that are mirrored.
    if is_short and _mirrored_markers(board, picture) > max(2, 2 * count):
        return (
            "shows the board mirrored: switch off mirroring (ReverseX, ReverseY) and take no "
            "pictures by way of a mirror"
        )
    if count < 3:
        return _why_no_markers(board, picture)
    largest = board.columns * board.rows // 2 - 1
    foreign = sorted({int(k) for k in marker_ids.ravel() if k > largest})
    if len(foreign) > 1:
        return (
            f"shows markers {foreign[0]} to {foreign[-1]}, and a board of {board.columns} x "
            f"{board.rows} squares ends with {largest}: another board"
        )
    if is_short:
        other = replace(board, legacy=not board.legacy)
        again = charuco_detector(other).detectBoard(picture)[1]
        if again is not None and len(again) >= MIN_CORNERS:
            return f"shows a board of the other layout: write --board {other.text}"
        return (
            f"shows {count} markers, but not in the places of {board.columns} x {board.rows} "
            "squares: another board"
            if count > 8
            else f"shows {count} markers of the board; more of it must be in the picture"
        )
    px = np.asarray(corners, np.float64).reshape(-1, 2)
    order = np.asarray(index, np.int64).ravel()
    measured_mm = _marker_mm(board, order, px, markers)
    side_px = np.linalg.norm(np.diff(np.asarray(markers).reshape(-1, 4, 2), axis=1), axis=2)
    # Outlines of markers shrink by about a pixel, more where they are blurred.
    tolerance = MARKER_TOLERANCE + _MARKER_SHRINKS_PX / float(np.median(side_px))
    if abs(measured_mm / board.marker_mm - 1.0) > tolerance:
        return (
            f"shows markers of {measured_mm / board.square_mm:.3f} of a square; {board.text} has "
            f"{board.marker_mm / board.square_mm:.3f}: measure square and marker of the board again"
        )
    return order, px


def _mirrored_markers(board: CalibrationBoard, picture: Picture) -> int:
    found = charuco_detector(board).detectBoard(np.ascontiguousarray(picture[:, ::-1]))[3]
    return 0 if found is None else len(found)


def _why_no_markers(board: CalibrationBoard, picture: Picture) -> str:
    for name in ("4x4_1000", "5x5_1000", "6x6_1000", "7x7_1000"):
        if name.partition("_")[0] == board.dictionary.partition("_")[0]:
            continue
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])
        ids = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)[1]
        if ids is not None and len(ids) >= 3:
            return f"shows markers of dictionary {name}, not {board.dictionary}: see --board"
    return "shows no marker of the board: too dark, too blurred, or no board"


def _chessboard(board: CalibrationBoard, picture: Picture) -> tuple[Indices, Array] | str:
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCornersSB(picture, (board.columns, board.rows), flags)
    if not found:
        return (
            f"shows no chessboard of {board.columns} x {board.rows} inner corners: the whole board "
            "must be in the picture, in focus, with a white border"
        )
    px = np.asarray(corners, np.float64).reshape(board.rows, board.columns, 2)
    right, down = px[0, -1] - px[0, 0], px[-1, 0] - px[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0.0:
        px = px[:, ::-1]
    if board.is_orientable and _is_upside_down(px, picture):
        px = px[::-1, ::-1]
    return np.arange(board.rows * board.columns), px.reshape(-1, 2)


def _is_upside_down(px: Array, picture: Picture) -> bool:
    """Whether the first inner square is bright; by convention it is dark."""
    middle = (px[:-1, :-1] + px[1:, :-1] + px[:-1, 1:] + px[1:, 1:]) / 4.0
    column, row = np.round(middle).astype(int).transpose(2, 0, 1)
    values = picture[
        np.clip(row, 0, picture.shape[0] - 1), np.clip(column, 0, picture.shape[1] - 1)
    ].astype(float)
    parity = np.add.outer(np.arange(values.shape[0]), np.arange(values.shape[1])) % 2
    return bool(values[parity == 0].mean() > values[parity == 1].mean())


def _plane_mm(board: CalibrationBoard, index: Indices) -> Array:
    return board.corners_m[index, :2] * 1e3


def _misfit_squares(board: CalibrationBoard, index: Indices, px: Array) -> float:
    """Largest distance of a corner from a plane board, by a homography, in squares."""
    plane = _plane_mm(board, index)
    homography, _ = cv2.findHomography(px, plane)
    if homography is None:
        return np.inf
    off = cv2.perspectiveTransform(px[None], homography)[0] - plane
    return float(np.hypot(*off.T).max()) / board.square_mm


def _marker_mm(board: CalibrationBoard, index: Indices, px: Array, markers: Any) -> float:
    """Median side of the markers, by the squares around them."""
    homography, _ = cv2.findHomography(px, _plane_mm(board, index))
    if homography is None:
        return board.marker_mm
    corners = np.asarray(markers, np.float64).reshape(-1, 4, 2)
    plane = cv2.perspectiveTransform(corners.reshape(1, -1, 2), homography).reshape(-1, 4, 2)
    sides = np.linalg.norm(plane - np.roll(plane, 1, axis=1), axis=2)
    return float(np.median(sides))
