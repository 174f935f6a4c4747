"""Emulated laboratory set-ups: collimator, calibration field, integrating sphere."""
