"""Bundle adjustment from and to text files: a project in TOML and tables in CSV.

The mathematics is in `processing.bundle`; here are the files, and the report of a result.
"""
