"""What runs after landing: adjustment, calibration, exchange, replay and reports."""
