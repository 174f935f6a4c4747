"""Thermometers that send lines of text."""
