"""Temperatures the host itself measures."""
