"""`syntopic bench`: timing of the pipeline and of other software."""
