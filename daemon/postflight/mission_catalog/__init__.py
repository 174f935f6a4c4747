"""Catalog of many missions: a table of exposures, STAC collections, and queries."""
