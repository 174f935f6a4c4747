"""GenICam heads (GigE Vision, USB3 Vision) through Aravis.

Importing this loads neither gi nor Aravis; that happens when a head is bound.
"""
