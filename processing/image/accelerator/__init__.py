"""The kernels that make pixels, on an accelerator that the configuration chooses."""
