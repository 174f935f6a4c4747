"""Verification of a mission by its hash chain, and recovery after a crash."""
