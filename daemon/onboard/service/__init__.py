"""The running service: its processes, their messages, and its event loop."""
