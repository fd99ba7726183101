"""Meshes and the operators on them."""

from meshanim.geometry.mesh import TriangleMesh

__all__ = ["TriangleMesh"]
