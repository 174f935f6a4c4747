"""Free image mosaicking: the adjustment of one exposure, and its validation."""
