"""Delays of heads in `syntopic calibrate boresight`: the block moves along the trajectory.

Velocities and rates hold at the instant of an exposure, which follows from the comparison with the
trajectory; block and comparison are repeated with what was found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from daemon.configuration.model import MountSection
from daemon.postflight.calibration.boresight_calibration import (
    BoresightComparison,
    BoresightError,
    compare_boresight,
    given_mounting,
)
from daemon.postflight.calibration.calibration_report import Quantity
from processing.bundle.adjust import Adjustment
from processing.bundle.head_times import confounded_times, head_times, jitter_sigmas
from processing.bundle.network import Network
from processing.calibration.boresight import ImuMounting, InertialOrientations, rig_motion
from processing.calibration.head_delays import head_delays
from processing.calibration.motion_consistency import motion_consistency

_ROUNDS: Final = 12
_TIME_CONVERGED_S: Final = 1e-5
_JITTER_CONVERGED: Final = 0.05
_MIN_JITTER_S: Final = 1e-5
"""Below this, jitter moves no pixel, and its standard deviation is not estimated further."""


def has_times(network: Network) -> bool:
    """Whether images of the network depend on the motion of the rig."""
    return any(head.timing.uses_motion for head in network.heads)


def compare_with_delays(
    network: Network,
    adjust: Callable[[Network], Adjustment],
    exposures: Sequence[int],
    inertial: InertialOrientations,
    mount: MountSection,
    *,
    held: Sequence[str] = (),
    lever_sigma_m: float | None = None,
) -> BoresightComparison:
    """Adjust with the motion of the rig and compare, until instants and jitter no longer change.

    Args:
        network: heads with their timing; control only.
        adjust: adjusts a network.
        exposures: stations with inertial values, by index.
        inertial: those values.
        mount: in use.
        held, lever_sigma_m: as of `compare_boresight`.

    Raises:
        BoresightError: velocities or rates that do not fit positions and attitudes, an exposure
            without inertial values, or no convergence.
    """
    if inertial.time_s is None:
        raise BoresightError(
            "inertial.csv: delays of heads need the column time_s (seconds): by it velocities and "
            "rates are compared with positions and attitudes"
        )
    contradictions = motion_consistency(inertial).problems
    if contradictions:
        raise BoresightError("; ".join(contradictions))
    names = network.stations.names
    missing = sorted(set(range(len(names))) - set(exposures))
    if missing:
        raise BoresightError(
            f"{len(missing)} exposures of the project have no inertial values, first "
            f"{names[missing[0]]}; delays of heads need the motion at every exposure"
        )
    mounting = given_mounting(mount)
    order = np.argsort(np.asarray(exposures))
    for _ in range(_ROUNDS):
        adjusted = adjust(_moving(network, order, inertial, mounting))
        done = compare_boresight(
            adjusted, exposures, inertial, mount, held=held, lever_sigma_m=lever_sigma_m
        )
        found = done.found.mounting
        moved_s = abs(found.time_offset_s - mounting.time_offset_s)
        mounting = found
        network, jitter_change = _with_jitter(network, jitter_sigmas(adjusted))
        if moved_s < _TIME_CONVERGED_S and jitter_change < _JITTER_CONVERGED:
            return done
    raise BoresightError(
        f"delays and jitter of heads still change after {_ROUNDS} rounds; give jitter_sigma_ms "
        "nearer to its value, or none where the heads have none"
    )


def delay_quantities(done: BoresightComparison) -> tuple[Quantity, ...]:
    """Delay against the marks, readout time and jitter of every head, ms."""
    if not has_times(done.adjustment.network):
        return ()
    against_marks = head_delays(done.adjustment, done.exposures, done.found)
    totals = dict(zip(against_marks.names, against_marks.delay_s, strict=True))
    sigmas = dict(zip(against_marks.names, against_marks.sigma_s, strict=True))
    quantities = []
    for head in head_times(done.adjustment):
        name = f"head {head.name}"
        own = [
            ("delay after the mark", totals[head.name], sigmas[head.name]),
            ("delay after the rig's instant", head.delay_s, head.delay_sigma_s),
        ]
        if head.readout_s != 0.0:
            own.append(("readout time", head.readout_s, head.readout_sigma_s))
        if np.isfinite(head.jitter_s):
            own.append(("jitter, root mean square", head.jitter_s, np.nan))
        quantities += [
            Quantity(name, what, "ms", value * 1e3, sigma * 1e3 if np.isfinite(sigma) else None)
            for what, value, sigma in own
        ]
    return tuple(quantities)


def delay_warnings(done: BoresightComparison) -> tuple[str, ...]:
    """Delays and readout times that the flight does not separate from something else."""
    return confounded_times(done.adjustment)


def _moving(
    network: Network,
    order: np.ndarray,
    inertial: InertialOrientations,
    mounting: ImuMounting,
) -> Network:
    motion = rig_motion(inertial, mounting)
    return replace(
        network,
        motion=replace(
            motion,
            velocity_mps=motion.velocity_mps[order],
            acceleration_mps2=motion.acceleration_mps2[order],
            rate_rad_per_s=motion.rate_rad_per_s[order],
            rate_change_rad_per_s2=motion.rate_change_rad_per_s2[order],
        ),
    )


def _with_jitter(network: Network, sigmas: dict[str, float]) -> tuple[Network, float]:
    """The network with these standard deviations of jitter, and their largest relative change."""
    heads, change = [], 0.0
    for head in network.heads:
        before = head.timing.jitter_sigma_s
        if before is None:
            heads.append(head)
            continue
        after = max(sigmas[head.name], _MIN_JITTER_S)
        change = max(change, abs(float(np.log(after / before))))
        heads.append(replace(head, timing=replace(head.timing, jitter_sigma_s=after)))
    return replace(network, heads=tuple(heads)), change
