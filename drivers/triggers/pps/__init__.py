"""Pulses per second through the kernel's PPS interface."""
