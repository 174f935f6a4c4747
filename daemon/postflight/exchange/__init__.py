"""Blocks of oriented images in the files of other photogrammetric programs, out and in."""
