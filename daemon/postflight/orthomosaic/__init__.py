"""Orthomosaic of a mission after landing."""
