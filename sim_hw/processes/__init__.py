"""Emulated devices as processes: one device alone, or a whole flight."""
