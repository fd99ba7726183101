"""Meshes and the operators on them."""

from meshanim.geometry.geodesics import HeatGeodesics
from meshanim.geometry.laplacian import cotangent_laplacian, vertex_masses
from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.normals import face_normals, vertex_normals
from meshanim.geometry.subdivision import bilinear_operator, catmull_clark_operator
from meshanim.geometry.uv import rasterize_uv

__all__ = [
    "HeatGeodesics",
    "TriangleMesh",
    "bilinear_operator",
    "catmull_clark_operator",
    "cotangent_laplacian",
    "face_normals",
    "rasterize_uv",
    "vertex_masses",
    "vertex_normals",
]
