"""The worker processes and the queue of exposures in front of them."""
