"""The commands `syntopic calibrate`: from measurements to a dated calibration and its report."""
