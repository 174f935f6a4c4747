"""Bundle adjustment from and to text files: a project in TOML beside tables in CSV.

The mathematics is in `processing.bundle`; here are the files, and what is told of a result.
"""
