"""Configuration files of a new rig from its devices and a few answers; `syntopic init` asks
them."""
