"""Meshes and the operators on them."""

from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.subdivision import bilinear_operator, catmull_clark_operator
from meshanim.geometry.uv import rasterize_uv

__all__ = ["TriangleMesh", "bilinear_operator", "catmull_clark_operator", "rasterize_uv"]
