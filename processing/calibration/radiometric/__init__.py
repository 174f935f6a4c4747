"""How a sensor's radiometric calibration is found from dark and flat series.

`dark_signal` fits bias and dark signal, `photon_transfer` and `spatial_noise` compute the figures
of EMVA 1288, `defects` finds pixels, columns and clusters, `vignetting` models the effect of the
aperture. The calibration and its application are in `processing.radiometry.calibration` and
`processing.radiometry.level1`.
"""
