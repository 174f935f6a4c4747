"""Cameras and planes: lens, placement, drift, topology, the virtual camera."""
