"""A recorded flight through the same code again: codecs, matching, ledger, pipeline (promise 8)."""
