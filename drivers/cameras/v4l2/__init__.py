"""Heads behind the kernel's video capture API, V4L2.

Importing this opens nothing and needs nothing but the standard library.
"""
