"""Fuzzing of every parser that meets a network or a file of others."""
