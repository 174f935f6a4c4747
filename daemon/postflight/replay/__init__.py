"""A recorded flight through the same code again: codecs, matching, ledger, pipeline.

How-to: docs/how-to/processing/replay.md.
"""
