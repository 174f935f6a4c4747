"""Orientation of images and their footprints."""
