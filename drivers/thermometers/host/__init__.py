"""Temperatures measured by the host itself."""
