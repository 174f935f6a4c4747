"""Variance components: factors on the sigmas of each kind of observation, from its residuals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from processing.bundle.network import HeadMounting, Network
from processing.bundle.statistics import ObservationGroup

_CONVERGED: Final = 0.02
_MIN_REDUNDANCY: Final = 15.0
"""A variance factor is then known to about a third or better."""


def estimable_factors(groups: Iterable[ObservationGroup]) -> dict[str, float]:
    """Variance factors of the kinds of observation that have enough redundancy.

    Args:
        groups: statistics of an adjustment.

    Returns:
        Factor on the a priori variance by name of the kind.

    Source: docs/explanation/mathematics/bundle.md#adjustment.

    Example:
        >>> plan = ObservationGroup("GNSS plan", 40, 20.0, 2.5, 0.05, 0.1)
        >>> height = ObservationGroup("GNSS height", 20, 9.0, 1.5, 0.05, 0.1)
        >>> estimable_factors([plan, height])
        {'GNSS plan': 2.5}
    """
    return {group.name: group.factor for group in groups if _is_estimable(group)}


def are_changing(groups: Iterable[ObservationGroup], factors: Mapping[str, float]) -> bool:
    """Whether a variance component still differs from what the sigmas hold.

    Args:
        groups: statistics of an adjustment with those sigmas.
        factors: variance factors that the sigmas hold, by name of the kind.

    Returns:
        True if one differs by more than 2 %.

    Source: docs/explanation/mathematics/bundle.md#adjustment.

    Example:
        >>> plan = ObservationGroup("GNSS plan", 40, 20.0, 2.5, 0.05, 0.1)
        >>> are_changing([plan], {}), are_changing([plan], {"GNSS plan": 2.48})
        (True, False)
    """
    return any(
        _is_estimable(g) and abs(np.log(g.factor / factors.get(g.name, 1.0))) > _CONVERGED
        for g in groups
    )


def rescaled(network: Network, factors: Mapping[str, float]) -> Network:
    """The network with each kind's sigmas multiplied by the root of its variance factor.

    Args:
        network: a priori sigmas.
        factors: variance factors by name of the kind; others are 1.

    Returns:
        The network itself where there are no factors.

    Source: docs/explanation/mathematics/bundle.md#adjustment.
    """
    if not factors:
        return network
    root = {name: float(np.sqrt(value)) for name, value in factors.items()}

    def of(name: str) -> float:
        return root.get(name, 1.0)

    table, points, gnss = network.image_points, network.points, network.gnss
    plan_height = np.array([of("control plan"), of("control plan"), of("control height")])
    gnss_scale = np.array([of("GNSS plan"), of("GNSS plan"), of("GNSS height")])
    return replace(
        network,
        image_points=replace(
            table, sigma_mm=table.sigma_mm * np.array([of("image x"), of("image y")])
        ),
        points=replace(points, sigma_m=points.sigma_m * plan_height),
        gnss=replace(gnss, sigma_m=gnss.sigma_m * gnss_scale),
        measured_attitudes=replace(
            network.measured_attitudes,
            sigma_rad=network.measured_attitudes.sigma_rad * of("attitude"),
        ),
        distances=replace(network.distances, sigma_m=network.distances.sigma_m * of("distance")),
        heads=tuple(_with_jitter(head, of("jitter")) for head in network.heads),
    )


def _with_jitter(head: HeadMounting, factor: float) -> HeadMounting:
    sigma_s = head.timing.jitter_sigma_s
    if sigma_s is None:
        return head
    return replace(head, timing=replace(head.timing, jitter_sigma_s=sigma_s * factor))


def _is_estimable(group: ObservationGroup) -> bool:
    return bool(
        np.isfinite(group.factor) and group.factor > 0.0 and group.redundancy >= _MIN_REDUNDANCY
    )
