"""Frames, rasters and records on disk, written durably."""
