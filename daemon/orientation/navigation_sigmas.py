"""Standard deviations of navigation and mounting: the same in flight and after landing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daemon.configuration.model import ConfigurationError, TriangulationSection
from daemon.mission.layout import Mission
from daemon.orientation.exterior_orientation import ExteriorOrientation
from processing.bundle.flown_network import MountingPrior

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NavigationSigmas:
    """Standard deviations of what is measured and calibrated.

    Attributes:
        position_m: (3,) of positions, east, north and up.
        attitude_mdeg: of roll, pitch and heading.
        boresight_mdeg, lever_arm_m: of the calibrated mounting, by coordinate.
        uses_stated: positions have the standard deviations that the receiver states, where it
            states any.
    """

    position_m: tuple[float, float, float] = (0.05, 0.05, 0.08)
    attitude_mdeg: tuple[float, float, float] = (5.0, 5.0, 8.0)
    boresight_mdeg: float = 6.0
    lever_arm_m: float = 0.02
    uses_stated: bool = True

    @property
    def about_camera_rad(self) -> Array:
        """Of attitudes about the camera's x (pitch), y (roll) and z (heading), (3,)."""
        return np.array(attitude_sigmas(self.attitude_mdeg))

    @property
    def prior(self) -> MountingPrior:
        """Of the mounting."""
        return MountingPrior(math.radians(self.boresight_mdeg * 1e-3), self.lever_arm_m)

    def of_position(self, eo: ExteriorOrientation) -> Array:
        """Standard deviations of a position east, north and up, (3,) m."""
        east_m, north_m, up_m = self.position_m
        if self.uses_stated and eo.horizontal_sigma_m is not None and eo.horizontal_sigma_m > 0.0:
            east_m = north_m = eo.horizontal_sigma_m
        if self.uses_stated and eo.vertical_sigma_m is not None and eo.vertical_sigma_m > 0.0:
            up_m = eo.vertical_sigma_m
        return np.array([east_m, north_m, up_m])


def navigation_sigmas(section: TriangulationSection) -> NavigationSigmas:
    """As configured."""
    plan_m = section.position_sigma_m
    return NavigationSigmas(
        (plan_m, plan_m, section.height_sigma_m),
        section.attitude_sigma_mdeg,
        section.boresight_sigma_mdeg,
        section.lever_arm_sigma_m,
    )


def flown_sigmas(mission: Mission) -> NavigationSigmas:
    """As configured for the flight; defaults where the mission has no configuration.

    Raises:
        ConfigurationError: the configuration cannot be used.
    """
    flown = dict(mission.flown_configuration().get("triangulation", {}))
    flown.pop("control_points", None)
    try:
        return navigation_sigmas(TriangulationSection.model_validate(flown))
    except ValueError as error:
        raise ConfigurationError([f"{mission.service_path}: {error}"]) from error


def attitude_sigmas(mdeg: tuple[float, float, float]) -> tuple[float, float, float]:
    """Sigmas about the camera's x, y, z of sigmas of roll, pitch and heading, mdeg, in rad.

    The camera looks down: its x is across (pitch), its y along the flight (roll).
    """
    roll, pitch, heading = (math.radians(v * 1e-3) for v in mdeg)
    return pitch, roll, heading
