"""Who fires: the pulse bus, and software triggers of the heads where there is no unit."""
