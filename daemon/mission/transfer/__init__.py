"""Copying a mission to another disk, and removing the source once the copy is verified."""
