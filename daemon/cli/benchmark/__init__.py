"""`syntopic bench`: the pipeline timed in turn with its peers."""
