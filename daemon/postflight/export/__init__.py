"""Missions for other programs: orientations, pictures, certificates, logs."""
