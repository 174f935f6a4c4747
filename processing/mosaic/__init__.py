"""Free image mosaicking: the adjustment of one exposure, and whether it is to be believed."""
