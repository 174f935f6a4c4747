"""Writing features of a head: what it holds afterwards, and one sentence for each refusal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivers.cameras.aravis.feature_access import (
    RELATIVE_TOLERANCE,
    FeatureError,
    Features,
)
from drivers.cameras.aravis.presets import FeatureValue


class FeatureWriter:
    """Collects what a head holds and what it refuses.

    Args:
        features: the head's features.

    `written` holds what the head holds afterwards, by feature; `refusals` one sentence per error;
    `missing` what no head can be used without, such as `no feature Width`.
    """

    def __init__(self, features: Features) -> None:
        self.features = features
        self.written: dict[str, FeatureValue] = {}
        self.refusals: list[str] = []
        self.missing: list[str] = []

    def set(
        self,
        key: str,
        name: str,
        value: FeatureValue,
        hint: str,
        *,
        tolerance: float = RELATIVE_TOLERANCE,
        within: float = 0.0,
    ) -> bool:
        """Write a feature.

        Args:
            key: the setting that asks for it.
            name: GenICam name.
            value: in the type of the feature.
            hint: what to do if it is refused.
            tolerance: relative, between a number and the one that the head then holds.
            within: the same, absolute, in the unit of the feature.

        Returns:
            Whether the head holds the value.
        """
        try:
            self.written[name] = self.features.set(name, value, tolerance=tolerance, within=within)
        except FeatureError as error:
            wanted = f"{key} = {value!r}" if isinstance(value, int | float) else key
            self.refusals.append(f"{wanted} is refused ({error}); {hint}")
            return False
        return True

    def attempt(self, what: str, hint: str, action: Callable[[], Any]) -> None:
        """Run a step.

        Args:
            what: the step, for the sentence.
            hint: what to do if it is refused.
            action: the step; may raise FeatureError.
        """
        try:
            action()
        except FeatureError as error:
            self.refusals.append(f"{what} is refused ({error}); {hint}")
