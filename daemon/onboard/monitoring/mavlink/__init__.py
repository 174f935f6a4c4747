"""The MAVLink camera: commands, senders and signatures."""
