"""The running service: its processes, what they say to each other, and its one loop."""
