"""Random search for wrong inputs whose images pass as good."""
