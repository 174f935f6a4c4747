"""How a sensor's radiometric calibration is found from dark and flat series.

`dark_signal` fits bias and dark signal, `photon_transfer` and `spatial_noise` say what EMVA 1288
asks, `defects` finds pixels, columns and clusters, `vignetting` what the diaphragm changes. What a
calibration is and how it is applied is in `processing.radiometry.calibration` and
`processing.radiometry.level1`.
"""
