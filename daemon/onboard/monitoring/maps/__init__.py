"""Base maps of the page: tiles from files of the operator, without any network."""
