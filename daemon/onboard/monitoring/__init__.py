"""Watching a flight: state for those who look, and the way in for those who may command.

A process of its own, fed by the service through a line that drops rather than waits: watching never
costs a frame. The service never imports from here.
"""
