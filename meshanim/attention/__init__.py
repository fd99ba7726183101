"""Sparse attention over mesh adjacency."""
