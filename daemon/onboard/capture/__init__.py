"""The process of the devices: heads, receivers, probes and triggers."""
