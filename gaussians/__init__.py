"""Gaussians on meshes."""
