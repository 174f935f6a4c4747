"""The orthomosaic that grows in flight: map tiles, and its files at landing."""
