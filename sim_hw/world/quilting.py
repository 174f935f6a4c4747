"""Image quilting: one large picture out of patches of a few photographs, at full sharpness.

Patches, each a cell of a photograph in one of eight orientations and used once, are joined by
minimum-error boundary cuts, after Efros and Freeman, Image Quilting for Texture Synthesis and
Transfer, 2001; nothing is blended, so nothing is blurred. They are drawn one after another, or
arranged by `quilt_layout` and levelled by `quilt_levelling`. Radiometry of a scene is in `scene`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from sim_hw.world import quilt_layout, quilt_levelling

Picture = NDArray[np.uint16]
"""Shape (height, width, bands)."""

PATCH_PX = 368
OVERLAP_PX = 48
THUMB = 16
"""Candidates are compared on thumbnails reduced by this factor; it divides the two above."""
CANDIDATES = 160
MIN_REPEAT_DISTANCE = 2
"""A cell is not used again, in whatever orientation, within this many patches."""
PAINT_STEP = 4
PAINT_RATIO = 1.25
PAINT_LEVEL = 6000
PAINT_SAMPLES = 25
PAINT_COST = 4.0
"""Of a patch with painted lines, in medians of the cost of two neighbours: used last."""
ORIENTATIONS = 8
_TURNS = (cv2.ROTATE_90_COUNTERCLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE)
_SIDES = ("left", "right", "top", "bottom")


@dataclass(frozen=True)
class ImagePatch:
    """Where a patch comes from: source picture, upper left corner of its cell, orientation 0-7."""

    source: int
    row: int
    column: int
    orientation: int

    @property
    def cell(self) -> tuple[int, int, int]:
        return self.source, self.row, self.column


@dataclass(frozen=True)
class Quilt:
    """A plan of patches, row by row.

    `reused` counts patches that had to be taken a second time; `gains` are those of the corners of
    every patch, (rows, columns, 2, 2, bands).
    """

    rows: tuple[tuple[ImagePatch, ...], ...]
    reused: int
    gains: NDArray[np.float32] | None = None


def oriented(picture: NDArray[np.generic], orientation: int) -> NDArray[np.generic]:
    """One of the eight orientations of a square: quarter turns, then mirrored."""
    rotated = np.rot90(picture, orientation % 4)
    return rotated[:, ::-1] if orientation >= 4 else rotated


def _turned(cell: Picture, orientation: int) -> Picture:
    """As `oriented`, a copy."""
    turned = cell if orientation % 4 == 0 else cv2.rotate(cell, _TURNS[orientation % 4 - 1])
    flipped = cv2.flip(turned, 1) if orientation >= 4 else turned
    return np.asarray(np.ascontiguousarray(flipped), dtype=np.uint16)


def patches_of(sources: Sequence[Picture]) -> list[ImagePatch]:
    """All patches that the sources hold: cells do not overlap."""
    found = []
    for index, source in enumerate(sources):
        height, width = source.shape[:2]
        if min(height, width) < PATCH_PX:
            raise ValueError(
                f"source picture {index} is {width} x {height} px; a patch needs {PATCH_PX} px"
            )
        for row in range(0, height - PATCH_PX + 1, PATCH_PX):
            for column in range(0, width - PATCH_PX + 1, PATCH_PX):
                found += [ImagePatch(index, row, column, o) for o in range(ORIENTATIONS)]
    return found


def plan_quilt(
    sources: Sequence[Picture], *, height_px: int, width_px: int, random: np.random.Generator
) -> Quilt:
    """Choose patches row by row: each fits best of candidates drawn at random.

    The ground of most measurements; `plan_land` arranges the patches over the whole picture.
    """
    step = PATCH_PX - OVERLAP_PX
    rows = -(-(height_px - OVERLAP_PX) // step)
    columns = -(-(width_px - OVERLAP_PX) // step)
    patches = patches_of(sources)
    edges = _edges(sources, patches)
    free = np.ones(len(patches), dtype=bool)
    cells = np.array([hash(p.cell) for p in patches])
    chosen = np.full((rows, columns), -1)
    reused = 0
    for r in range(rows):
        for c in range(columns):
            if not free.any():
                free[:] = True
                reused += 1
            elif reused:
                reused += 1
            near = chosen[
                max(0, r - MIN_REPEAT_DISTANCE) : r + 1,
                max(0, c - MIN_REPEAT_DISTANCE) : c + MIN_REPEAT_DISTANCE + 1,
            ]
            allowed = free & ~np.isin(cells, cells[near[near >= 0]])
            pool = np.flatnonzero(allowed if allowed.any() else free)
            pool = random.permutation(pool)[:CANDIDATES]
            cost = np.zeros(pool.size)
            if c > 0:
                cost += _mismatch(edges["left"][pool], edges["right"][chosen[r, c - 1]])
            if r > 0:
                cost += _mismatch(edges["top"][pool], edges["bottom"][chosen[r - 1, c]])
            best = int(pool[np.argmin(cost)])
            chosen[r, c] = best
            free[best] = False
    return Quilt(
        rows=tuple(tuple(patches[i] for i in row) for row in chosen),
        reused=reused,
    )


def plan_land(
    sources: Sequence[Picture], *, height_px: int, width_px: int, random: np.random.Generator
) -> Quilt:
    """Choose and arrange patches so that neighbours fit, and level them."""
    step = PATCH_PX - OVERLAP_PX
    rows = -(-(height_px - OVERLAP_PX) // step)
    columns = -(-(width_px - OVERLAP_PX) // step)
    patches = patches_of(sources)
    edges = _edges(sources, patches)
    numbers = {cell: k for k, cell in enumerate(dict.fromkeys(p.cell for p in patches))}
    chosen = quilt_layout.arrange(
        (rows, columns),
        _mismatches(edges["right"], edges["left"]),
        _mismatches(edges["bottom"], edges["top"]),
        _paint(sources, patches),
        np.array([numbers[p.cell] for p in patches]),
        random,
    )
    return Quilt(
        rows=tuple(tuple(patches[i] for i in row) for row in chosen),
        reused=max(rows * columns - len(patches), 0),
        gains=quilt_levelling.corner_gains(
            *(_ends(edges[side], side, sources[0].shape[2])[chosen] for side in _SIDES)
        ),
    )


def assemble(sources: Sequence[Picture], quilt: Quilt, *, height_px: int, width_px: int) -> Picture:
    """Lay the patches of a plan out and cut them together, shape (height, width, bands)."""
    step = PATCH_PX - OVERLAP_PX
    rows, columns = len(quilt.rows), len(quilt.rows[0])
    full = (rows * step + OVERLAP_PX, columns * step + OVERLAP_PX, sources[0].shape[2])
    canvas = np.empty(full, dtype=np.uint16)
    for r, row in enumerate(quilt.rows):
        for c, patch in enumerate(row):
            y, x = r * step, c * step
            cell = sources[patch.source][
                patch.row : patch.row + PATCH_PX, patch.column : patch.column + PATCH_PX
            ]
            new = _turned(cell, patch.orientation)
            if quilt.gains is not None:
                new = quilt_levelling.scaled(new, quilt.gains[r, c])
            place = canvas[y : y + PATCH_PX, x : x + PATCH_PX]
            left, top = np.zeros(PATCH_PX, np.int64), np.zeros(PATCH_PX, np.int64)
            if c > 0:
                left = least_error_cut(_difference(place[:, :OVERLAP_PX], new[:, :OVERLAP_PX]))
            if r > 0:
                top = least_error_cut(_difference(place[:OVERLAP_PX], new[:OVERLAP_PX]).T)
            _lay(place, new, left, top)
    return canvas[:height_px, :width_px]


def least_error_cut(error: NDArray[np.float32]) -> NDArray[np.int64]:
    """The path down a strip (length, width) of least summed error: a column for every line."""
    return np.asarray(_cut(np.ascontiguousarray(error)))


@numba.njit(cache=True, nogil=True, fastmath=False)
def _cut(error: NDArray[np.float32]) -> NDArray[np.int64]:
    length, width = error.shape
    total = error.astype(np.float64)
    for i in range(1, length):
        for j in range(width):
            best = total[i - 1, j]
            if j > 0 and total[i - 1, j - 1] < best:
                best = total[i - 1, j - 1]
            if j < width - 1 and total[i - 1, j + 1] < best:
                best = total[i - 1, j + 1]
            total[i, j] += best
    path = np.empty(length, dtype=np.int64)
    j = int(np.argmin(total[length - 1]))
    path[length - 1] = j
    for i in range(length - 2, -1, -1):
        low = max(j - 1, 0)
        high = min(j + 2, width)
        j = low + int(np.argmin(total[i, low:high]))
        path[i] = j
    return path


@numba.njit(cache=True, nogil=True, fastmath=True)
def _lay(place: Picture, new: Picture, left: NDArray[np.int64], top: NDArray[np.int64]) -> None:
    """Write a patch right of its left cut and below its upper one."""
    rows, columns, bands = new.shape
    for i in range(rows):
        for j in range(left[i], columns):
            if i >= top[j]:
                for k in range(bands):
                    place[i, j, k] = new[i, j, k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _difference(a: Picture, b: Picture) -> NDArray[np.float32]:
    """Squared difference of two overlaps as the eye sees it: of square roots of radiance."""
    rows, columns, bands = a.shape
    out = np.zeros((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            for k in range(bands):
                root = np.sqrt(np.float32(a[i, j, k])) - np.sqrt(np.float32(b[i, j, k]))
                out[i, j] += root * root
    return out


def _edges(
    sources: Sequence[Picture], patches: Sequence[ImagePatch]
) -> dict[str, NDArray[np.float32]]:
    """The four overlap strips of every patch on thumbnails, shape (patches, values)."""
    size = PATCH_PX // THUMB
    width = OVERLAP_PX // THUMB
    strips: dict[str, list[NDArray[np.float32]]] = {k: [] for k in _SIDES}
    cells: dict[tuple[int, int, int], NDArray[np.float32]] = {}
    for patch in patches:
        if patch.cell not in cells:
            cell = sources[patch.source][
                patch.row : patch.row + PATCH_PX, patch.column : patch.column + PATCH_PX
            ]
            small = cv2.resize(
                np.ascontiguousarray(cell), (size, size), interpolation=cv2.INTER_AREA
            )
            cells[patch.cell] = np.sqrt(small.astype(np.float32))
        thumb = np.asarray(oriented(cells[patch.cell], patch.orientation), dtype=np.float32)
        strips["left"].append(thumb[:, :width].ravel())
        strips["right"].append(thumb[:, size - width :].ravel())
        strips["top"].append(thumb[:width].ravel())
        strips["bottom"].append(thumb[size - width :].ravel())
    return {side: np.stack(values) for side, values in strips.items()}


def _mismatches(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared differences of all strips of one side (n, values) to all of the other, (n, n)."""
    squares = np.sum(first**2, axis=1)[:, None] + np.sum(second**2, axis=1)[None, :]
    return np.asarray(np.maximum(squares - 2.0 * first @ second.T, 0.0), dtype=np.float32)


def _mismatch(candidates: NDArray[np.float32], placed: NDArray[np.float32]) -> NDArray[np.float64]:
    difference = candidates - placed
    return np.asarray(np.einsum("ij,ij->i", difference, difference), dtype=np.float64)


def _paint(sources: Sequence[Picture], patches: Sequence[ImagePatch]) -> NDArray[np.float32]:
    """Cost of patches with the coloured survey lines of the photographs, (patches,)."""
    found = []
    for source in sources:
        small = source[::PAINT_STEP, ::PAINT_STEP].astype(np.float32)
        red, green, blue = (small[..., k] for k in range(3))
        pink = np.minimum(red, blue) > PAINT_RATIO * green
        turquoise = np.minimum(green, blue) > PAINT_RATIO * red
        found.append((pink | turquoise) & (blue > PAINT_LEVEL))
    painted = []
    for patch in patches:
        r, c, size = (n // PAINT_STEP for n in (patch.row, patch.column, PATCH_PX))
        painted.append(found[patch.source][r : r + size, c : c + size].sum())
    return np.where(np.array(painted) >= PAINT_SAMPLES, PAINT_COST, 0.0).astype(np.float32)


def _ends(strips: NDArray[np.float32], side: str, bands: int) -> NDArray[np.float32]:
    """Logarithm of the mean radiance at both ends of the strips of a side, (n, 2, bands)."""
    size, width = PATCH_PX // THUMB, OVERLAP_PX // THUMB
    if side in ("left", "right"):
        along = strips.reshape(-1, size, width, bands).mean(axis=2)
    else:
        along = strips.reshape(-1, width, size, bands).mean(axis=1)
    third = size // 3
    ends = np.stack([along[:, :third].mean(axis=1), along[:, -third:].mean(axis=1)], axis=1)
    return np.asarray(2.0 * np.log(np.maximum(ends, 1.0)), dtype=np.float32)
