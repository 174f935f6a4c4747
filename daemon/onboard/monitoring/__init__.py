"""Monitoring of a flight: state for readers, and the path of commands.

A process of its own, fed by the service through a line that drops rather than waits: watching never
costs a frame. The service never imports from here.
"""
