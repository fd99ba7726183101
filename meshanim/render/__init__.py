"""Mesh rendering on the CPU and the procedural look of the default head."""
