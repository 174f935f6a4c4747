"""The V4L2 head against the real kernel; the tests here run in a virtual machine."""
