"""Lenses and relative orientation of heads from pictures of a board, by one bundle adjustment.

Source: docs/explanation/mathematics/lens.md#calibration-from-a-board.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from processing.bundle.adjust import Adjustment, AdjustmentSettings, adjust
from processing.bundle.adjustment_results import image_residuals_mm
from processing.bundle.network import INTERIOR, NetworkError
from processing.bundle.rank_diagnosis import RankDefectError
from processing.calibration.adjusted_heads import with_adjusted_heads
from processing.calibration.board.network import FREE, board_network, started, with_lens
from processing.calibration.board.relative_poses import RelativePoses, relative_poses
from processing.calibration.board.views import (
    SQUARE_ON_DEG,
    BoardView,
    ViewPose,
    pose_of,
)
from processing.matching.calibration_board import BoardError, CalibrationBoard
from processing.rig import Cone, Rig

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

START_SIGMA_PX: Final = 0.05
LEAST_VIEWS: Final = 4
"""Views of a head below which its lens is not adjusted."""
F_SIGMA_MAX: Final = 0.005
"""Relative standard deviation of a principal distance beyond which it counts as not found."""
SHAPE_SQUARES: Final = 0.02
"""Standard deviation of the board's corners, in squares, where its shape is looked for."""
_OUTLIER_FACTOR: Final = 3.0
_MAX_ROUNDS: Final = 12
_CONVERGED_SHARE: Final = 0.02
_CONVERGED_MM: Final = 1e-6


@dataclass(frozen=True)
class BoardSettings:
    """How to adjust: parameters of each lens, and how well the board is known (0: exactly)."""

    free: tuple[str, ...] = FREE
    board_sigma_mm: float = 0.0


@dataclass(frozen=True)
class BoardCalibration:
    """Result.

    `rig` has the new lenses, sensor places and mountings. `heads` have a new lens, `relative` the
    heads that are oriented against `reference`. `cofactor` of `adjustment` is a covariance: image
    noise is `sigma_px` as found. `shape_adjustment` has the corners of the board unknown, whatever
    the settings. `left_out` are sentences on views that were not used.
    """

    rig: Rig
    before: Rig
    board: CalibrationBoard
    settings: BoardSettings
    views: tuple[BoardView, ...]
    poses: tuple[ViewPose, ...]
    heads: tuple[str, ...]
    reference: str
    relative: RelativePoses
    adjustment: Adjustment
    shape_adjustment: Adjustment
    sigma_px: float
    single_sigma_px: Mapping[str, float]
    left_out: tuple[str, ...]

    def distance_m(self, head: str) -> float:
        """Mean distance of the board from a head.

        Args:
            head: its name.

        Returns:
            Metres.
        """
        own = [p.distance_m for v, p in zip(self.views, self.poses, strict=True) if v.head == head]
        return float(np.mean(own))

    @property
    def shape_m(self) -> tuple[Array, Array]:
        """Corners of the board less those drawn, and their standard deviations; (n, 3), m."""
        result = self.shape_adjustment
        given = result.network.points.xyz_m
        spread = np.diagonal(result.point_cofactor, axis1=1, axis2=2)
        return result.state.points - given, np.sqrt(np.clip(spread, 0.0, None))

    @property
    def oriented_heads(self) -> tuple[str, ...]:
        """Heads that are oriented relative to the reference."""
        return tuple(self.relative.mountings)

    @property
    def variance_factor(self) -> float:
        """What cofactors are multiplied with: image noise is scaled already."""
        return 1.0

    @property
    def is_complete(self) -> bool:
        """Whether every head has a new lens and is oriented relative to the reference."""
        return set(self.heads) == {cone.name for cone in self.rig.cones} and not (
            self.relative.unconnected
        )


def calibrate_board(
    rig: Rig,
    board: CalibrationBoard,
    views: Sequence[BoardView],
    settings: BoardSettings | None = None,
    *,
    progress: Progress | None = None,
) -> BoardCalibration:
    """Adjust the lenses of all heads with views, and their relative orientation.

    Every head is adjusted alone first, which finds views that do not fit; then all together.

    Args:
        rig: starting values; heads have one sensor each.
        board: as drawn.
        views: of all heads.
        settings: None: the defaults.
        progress: called with what is done, and counts.

    Returns:
        The rig with what was found, the adjustment and its selection of views.

    Raises:
        BoardError: what cannot be determined, named.

    Source: docs/explanation/mathematics/lens.md#calibration-from-a-board.
    """
    settings = settings or BoardSettings()
    report = progress or (lambda _what, _done, _total: None)
    master = rig.master_cone or rig.cones[0].name
    seen = [cone for cone in rig.cones if any(view.head == cone.name for view in views)]
    seen.sort(key=lambda cone: cone.name != master)
    cones: dict[str, Cone] = {}
    retained: list[BoardView] = []
    left_out: list[str] = []
    single_px: dict[str, float] = {}
    problems: list[str] = []
    for k, cone in enumerate(seen):
        report(f"lens of {cone.name}", k, len(seen))
        own = [view for view in views if view.head == cone.name]
        try:
            found, good, single_px[cone.name], sentences = _single_head(cone, board, own, settings)
        except BoardError as error:
            problems += error.problems
            continue
        cones[cone.name] = found
        retained += good
        left_out += sentences
    if problems:
        raise BoardError(*problems)
    heads = [cone.name for cone in seen]
    poses = [pose_of(cones[view.head], board, view.corners) for view in retained]
    relative = relative_poses(heads, retained, poses)
    wrong = set(relative.contradicting)
    left_out += relative.contradicting.values()
    retained = [view for k, view in enumerate(retained) if k not in wrong]
    poses = [pose for k, pose in enumerate(poses) if k not in wrong]
    report("all heads", len(seen), len(seen))
    ordered, result, sigma_px = _converged(
        [cones[name] for name in heads], board, retained, poses, relative, settings
    )
    shape = result
    if settings.board_sigma_mm == 0.0:
        free = replace(settings, board_sigma_mm=SHAPE_SQUARES * board.square_mm)
        _, shape, _ = _converged(ordered, board, retained, poses, relative, free, rounds=3)
    new = with_adjusted_heads(rig, ordered, result, relative.mountings, heads[0])
    final = {cone.name: cone for cone in new.cones}
    return BoardCalibration(
        rig=new,
        before=rig,
        board=board,
        settings=settings,
        views=tuple(retained),
        poses=tuple(pose_of(final[view.head], board, view.corners) for view in retained),
        heads=tuple(heads),
        reference=heads[0],
        relative=relative,
        adjustment=result,
        shape_adjustment=shape,
        sigma_px=sigma_px,
        single_sigma_px=single_px,
        left_out=tuple(left_out),
    )


def _single_head(
    cone: Cone, board: CalibrationBoard, views: Sequence[BoardView], settings: BoardSettings
) -> tuple[Cone, list[BoardView], float, list[str]]:
    """A head alone: its lens, the views that fit, the noise, and sentences on the others."""
    if len(views) < LEAST_VIEWS:
        raise BoardError(
            f"{cone.name}: {len(views)} usable picture{'s' * (len(views) != 1)} of the board; "
            f"{LEAST_VIEWS} at least are needed, tilted and rolled, and ten or more are better"
        )
    alone = RelativePoses({}, (), {}, {})
    left_out: list[str] = []
    good = list(views)
    cone = started(cone)
    _refuse_square_on(cone, board, good)
    # A lens of the rig file that is far off must not make good views look wrong.
    poses = [pose_of(cone, board, view.corners) for view in good]
    while True:
        # One view at a time: a wrong one spoils the lens for all others.
        (found,), result, sigma_px = _converged([cone], board, good, poses, alone, settings)
        rms = _rms_by_view(result, len(good)) / cone.sensors[0].pitch_mm
        worst = int(np.argmax(rms))
        others = float(np.median(np.delete(rms, worst)))
        if rms[worst] < max(_OUTLIER_FACTOR * others, 0.2) or len(good) <= LEAST_VIEWS:
            break
        left_out.append(
            f"{cone.name}, picture {good[worst].exposure}: residuals of {rms[worst]:.2f} px, the "
            f"others of {others:.2f} px: another head, a bent board or a moving one"
        )
        del good[worst]
        poses = [pose_of(found, board, view.corners) for view in good]
        cone = found
    _refuse_square_on(found, board, good)
    column = int(result.layout.interior[0][INTERIOR.index("df")])
    if column >= 0:
        share = math.sqrt(float(result.cofactor[column, column])) / found.lens.f_mm
        if share > F_SIGMA_MAX:
            raise BoardError(
                f"{found.name}: the principal distance is known to {share:.1%} only: it cannot be "
                "separated from the distance of the board; take views tilted by 20 to 40 degrees"
            )
    return found, good, sigma_px, left_out


def _refuse_square_on(cone: Cone, board: CalibrationBoard, views: Sequence[BoardView]) -> None:
    tilts = [pose_of(cone, board, view.corners).tilt_deg for view in views]
    if max(tilts) < SQUARE_ON_DEG:
        raise BoardError(
            f"{cone.name}: all {len(views)} pictures show the board perpendicular to the axis "
            f"(tilted by {max(tilts):.1f} degrees at most): the principal distance cannot be "
            "separated from the distance of the board. Tilt the board by 20 to 40 degrees, in all "
            "four directions"
        )


def _converged(
    cones: Sequence[Cone],
    board: CalibrationBoard,
    views: Sequence[BoardView],
    poses: Sequence[ViewPose],
    relative: RelativePoses,
    settings: BoardSettings,
    rounds: int = _MAX_ROUNDS,
) -> tuple[list[Cone], Adjustment, float]:
    """Adjust until principal points and distances rest and the noise is that of the residuals."""
    current = list(cones)
    mountings = dict(relative.mountings)
    sigma_px = START_SIGMA_PX
    for turn in range(rounds):
        network = board_network(
            current,
            board,
            views,
            poses,
            mountings,
            reference=cones[0].name,
            free=settings.free,
            sigma_px=sigma_px,
            board_sigma_mm=settings.board_sigma_mm,
        )
        try:
            result = adjust(network, AdjustmentSettings(robust=False, max_iterations=200))
        except RankDefectError as error:
            raise BoardError(*(d.sentence for d in error.rank_defects)) from error
        except NetworkError as error:
            names = ", ".join(cone.name for cone in cones)
            raise BoardError(
                f"{names}: the pictures do not fit the rig file ({'; '.join(error.problems)}); "
                "check "
                "focal length, pixel size and the size of the board"
            ) from error
        factor = _image_factor(result)
        moved = max(float(np.abs(row[:3]).max()) for row in result.state.interior)
        if turn > 1 and abs(factor - 1.0) < _CONVERGED_SHARE and moved < _CONVERGED_MM:
            break
        sigma_px *= factor
        current = [with_lens(c, i) for c, i in zip(current, result.state.interior, strict=True)]
        poses = _adjusted_poses(result, len(views))
        mountings = {
            head.name: (result.state.head_rotation[k], result.state.head_offset[k])
            for k, head in enumerate(network.heads)
            if k > 0
        }
    return (
        [with_lens(c, i) for c, i in zip(current, result.state.interior, strict=True)],
        result,
        sigma_px,
    )


def _adjusted_poses(result: Adjustment, count: int) -> list[ViewPose]:
    images, state = result.network.images, result.state
    found = []
    for k in range(count):
        rotation = state.attitude[images.attitude[k]]
        place = state.station[images.station[k]]
        if images.head[k] >= 0:
            place = place + rotation @ state.head_offset[images.head[k]]
            rotation = rotation @ state.head_rotation[images.head[k]]
        found.append(ViewPose(rotation.T, -rotation.T @ place))
    return found


def _image_factor(result: Adjustment) -> float:
    """Image noise found over that expected."""
    own = result.equations.group <= 1
    freedom = float(result.redundancy_number[own].sum())
    return math.sqrt(float(np.sum(result.residual[own] ** 2)) / max(freedom, 1.0))


def _rms_by_view(result: Adjustment, count: int) -> Array:
    squares = (image_residuals_mm(result) ** 2).mean(axis=1)
    image = result.network.image_points.image
    sums = np.bincount(image, weights=squares, minlength=count)
    return np.asarray(np.sqrt(sums / np.bincount(image, minlength=count)))
