"""Emulated devices that speak the real protocols, and the world they look at.

Projection and codecs are written here a second time, from the specifications: an emulator that
shared the pipeline's code would agree with its mistakes.
"""
