"""From corrected frames to rasters: resampling, seams, balance, colour."""
