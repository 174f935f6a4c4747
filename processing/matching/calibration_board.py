"""Calibration boards: ChArUco boards and chessboards as drawn, and their corners as object points.

What a picture shows of a board is found in `processing.matching.board_corners`.

Source: OpenCV, objdetect, `CharucoBoard` and `findChessboardCornersSB`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from processing import ProcessingError

Array = NDArray[np.float64]
BoardKind = Literal["charuco", "chessboard"]

DICTIONARIES: Final = {
    name[5:].lower(): getattr(cv2.aruco, name)
    for name in sorted(dir(cv2.aruco))
    if re.fullmatch(r"DICT_\dX\d_\d+", name)
}
_LENGTH: Final = re.compile(r"(\d+(?:\.\d+)?)(mm|cm|m|in)")
_LENGTHS_MM: Final = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
_SQUARE_MM: Final = (0.5, 2000.0)
_SIDE: Final = (3, 100)


class BoardError(ProcessingError, ValueError):
    """A board, or pictures of one, that cannot be used; one message a line for each mistake."""

    def __init__(self, *problems: str) -> None:
        self.problems = problems
        super().__init__("\n".join(problems))


@dataclass(frozen=True)
class CalibrationBoard:
    """A flat board.

    `columns` and `rows` count squares of a ChArUco board and inner corners of a chessboard, as
    OpenCV does. `legacy` is the layout of ChArUco boards with an even number of rows that were
    made before OpenCV 4.6.
    """

    kind: BoardKind
    columns: int
    rows: int
    square_mm: float
    marker_mm: float = 0.0
    dictionary: str = ""
    legacy: bool = False

    @property
    def corner_columns(self) -> int:
        """Columns of inner corners."""
        return self.columns - 1 if self.kind == "charuco" else self.columns

    @property
    def corner_rows(self) -> int:
        """Rows of inner corners."""
        return self.rows - 1 if self.kind == "charuco" else self.rows

    @property
    def is_orientable(self) -> bool:
        """Whether a picture shows which way up the board is.

        A chessboard with an odd and an even number of inner corners differs from itself upside
        down by its colours.
        """
        return self.kind == "charuco" or (self.columns + self.rows) % 2 == 1

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height between the outermost inner corners."""
        return (
            (self.corner_columns - 1) * self.square_mm,
            (self.corner_rows - 1) * self.square_mm,
        )

    @property
    def text(self) -> str:
        """The board as the command line has it."""
        size = f"{self.kind}:{self.columns}x{self.rows}:{self.square_mm:g}mm"
        if self.kind == "chessboard":
            return size
        legacy = ":legacy" if self.legacy else ""
        return f"{size}:{self.marker_mm:g}mm:{self.dictionary}{legacy}"

    @property
    def corners_m(self) -> Array:
        """Inner corners row by row: x right, y up, z towards the viewer, origin in the middle.

        Returns:
            Shape (corners, 3), m.
        """
        row, column = np.divmod(
            np.arange(self.corner_columns * self.corner_rows), self.corner_columns
        )
        x = column - (self.corner_columns - 1) / 2.0
        y = (self.corner_rows - 1) / 2.0 - row
        return np.asarray(np.stack([x, y, np.zeros(len(x))], axis=1) * self.square_mm * 1e-3)


def parse_board(text: str) -> CalibrationBoard:
    """Read a board from one argument.

    Args:
        text: `charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY[:legacy]]`, squares counted, or
            `chessboard:COLUMNSxROWS:SQUARE`, inner corners counted. Lengths have a unit.

    Returns:
        The board; a dictionary that is not given is the smallest one of 4 x 4 bits that has
        enough markers.

    Raises:
        BoardError: what is wrong, and an example of what would be right.

    Example:
        >>> parse_board("charuco:11x8:30mm:22mm").text
        'charuco:11x8:30mm:22mm:4x4_50'
        >>> parse_board("chessboard:9x6:2.5cm").square_mm
        25.0
    """
    kind, _, rest = text.strip().partition(":")
    parts = rest.split(":")
    if kind not in ("charuco", "chessboard"):
        raise BoardError(
            f"board {text!r} is of no known kind; write charuco:11x8:30mm:22mm (squares) or "
            "chessboard:9x6:25mm (inner corners)"
        )
    least, most = (2, 2) if kind == "chessboard" else (3, 5)
    if not least <= len(parts) <= most:
        example = "chessboard:9x6:25mm" if kind == "chessboard" else "charuco:11x8:30mm:22mm:4x4_50"
        raise BoardError(f"board {text!r} has {len(parts)} values after its kind; write {example}")
    columns, rows = _counts(parts[0], text)
    square_mm = _length_mm(parts[1], "square", text)
    if kind == "chessboard":
        if columns == rows:
            raise BoardError(
                f"board {text!r} is the same after a quarter turn; use one with different numbers "
                "of columns and rows"
            )
        return CalibrationBoard("chessboard", columns, rows, square_mm)
    marker_mm = _length_mm(parts[2], "marker", text)
    if not 0.3 * square_mm <= marker_mm < square_mm:
        raise BoardError(
            f"board {text!r}: a marker of {marker_mm:g} mm does not fit a square of {square_mm:g} "
            "mm; markers are 0.3 to 1 of the square: check the units"
        )
    markers = columns * rows // 2
    dictionary = parts[3].lower() if len(parts) > 3 else _smallest_dictionary(markers)
    if dictionary not in DICTIONARIES:
        raise BoardError(f"dictionary {dictionary!r} is none of {', '.join(DICTIONARIES)}")
    if markers > int(dictionary.rpartition("_")[2]):
        raise BoardError(
            f"board {text!r} has {markers} markers, more than dictionary {dictionary} holds"
        )
    if len(parts) > 4 and parts[4] != "legacy":
        raise BoardError(f"board {text!r} ends with {parts[4]!r}; only legacy may stand there")
    return CalibrationBoard(
        "charuco", columns, rows, square_mm, marker_mm, dictionary, legacy=len(parts) > 4
    )


@lru_cache(maxsize=8)
def charuco_detector(board: CalibrationBoard) -> Any:
    """OpenCV's detector of a ChArUco board.

    Args:
        board: a ChArUco board.

    Returns:
        A `cv2.aruco.CharucoDetector`.
    """
    drawn = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_mm,
        board.marker_mm,
        cv2.aruco.getPredefinedDictionary(DICTIONARIES[board.dictionary]),
    )
    drawn.setLegacyPattern(board.legacy)
    return cv2.aruco.CharucoDetector(drawn)


def _counts(text: str, whole: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    low, high = _SIDE
    if not found or not all(low <= int(n) <= high for n in found.groups()):
        raise BoardError(
            f"board {whole!r}: {text!r} is no number of columns and rows; write COLUMNSxROWS, each "
            f"{low} to {high}, such as 11x8"
        )
    return int(found[1]), int(found[2])


def _length_mm(text: str, what: str, whole: str) -> float:
    found = _LENGTH.fullmatch(text)
    if not found:
        raise BoardError(
            f"board {whole!r}: the {what} {text!r} has no unit; write it with mm, cm, m or in, "
            "such "
            "as 30mm"
        )
    value = float(found[1]) * _LENGTHS_MM[found[2]]
    low, high = _SQUARE_MM
    if not low <= value <= high:
        raise BoardError(
            f"board {whole!r}: a {what} of {value:g} mm is outside {low:g} to {high:g} mm; check "
            "the "
            "unit"
        )
    return round(value, 9)


def _smallest_dictionary(markers: int) -> str:
    return next((f"4x4_{size}" for size in (50, 100, 250, 1000) if markers <= size), "4x4_1000")
