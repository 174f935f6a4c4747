"""Finding out what speaks at a port: which protocol, at which speed, and the settings it needs."""
