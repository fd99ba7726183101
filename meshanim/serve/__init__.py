"""Servers: speech in and animation out over a network."""
