"""The value of a GenICam feature, as configurations and records hold it."""

from __future__ import annotations

FeatureValue = bool | int | float | str
