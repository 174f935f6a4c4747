"""VectorNav inertial units: binary outputs into records, and the device on a line."""
