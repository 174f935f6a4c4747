"""The unit as it is installed, with its whole hardening, under a systemd of its own."""
