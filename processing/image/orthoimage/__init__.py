"""Images on the ground: resampling to a map grid, seams, and levelling of their signal."""
