"""Post-flight processing: adjustment, calibration, exchange, replay and reports."""
