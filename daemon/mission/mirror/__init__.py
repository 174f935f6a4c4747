"""A mission on two disks: drop, return and resynchronisation."""
