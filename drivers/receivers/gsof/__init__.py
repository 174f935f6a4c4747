"""Trimble receivers and Applanix boards that send GSOF records."""
