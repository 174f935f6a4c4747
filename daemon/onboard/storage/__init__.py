"""The writer process and the coordination of one or two disks."""
