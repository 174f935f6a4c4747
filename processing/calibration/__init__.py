"""Calibrations from many exposures or from the laboratory."""
