"""Calibrations from laboratory series: a folder of images is read, measured and adjusted.

`series` reads a folder's list of images; one file for each calibration composes the mathematics of
`processing`. What a calibration leaves behind is in
`daemon.postflight.calibration.calibration_report`.
"""
