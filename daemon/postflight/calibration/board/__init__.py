"""`syntopic calibrate board`: pictures of a board, the calibration made from them, its report."""
