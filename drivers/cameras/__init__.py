"""Camera heads: GigE Vision, V4L2 and folders of images."""
