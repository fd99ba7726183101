"""Meshes and the operators on them."""

from meshanim.geometry.alignment import Similarity, align
from meshanim.geometry.closest_points import SurfacePoints, closest_points
from meshanim.geometry.correspondence import SurfaceCorrespondence, surface_correspondence
from meshanim.geometry.decimation import Decimation, Prolongation, decimate, prolongation
from meshanim.geometry.deformation import DeformationTransfer, deformation_gradients
from meshanim.geometry.frames import TriangleFrames, triangle_frames
from meshanim.geometry.geodesics import HeatGeodesics
from meshanim.geometry.laplacian import cotangent_laplacian, vertex_masses
from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.normals import face_normals, vertex_normals
from meshanim.geometry.quad_subdivision import bilinear_operator, catmull_clark_operator
from meshanim.geometry.repair import Repair, repair
from meshanim.geometry.subdivision import Subdivision, split_faces, subdivide
from meshanim.geometry.transfer import SparseOperator, carry, transfer_operator
from meshanim.geometry.uv import rasterize_uv

__all__ = [
    "Decimation",
    "DeformationTransfer",
    "HeatGeodesics",
    "Prolongation",
    "Repair",
    "Similarity",
    "SparseOperator",
    "Subdivision",
    "SurfaceCorrespondence",
    "SurfacePoints",
    "TriangleFrames",
    "TriangleMesh",
    "align",
    "bilinear_operator",
    "carry",
    "catmull_clark_operator",
    "closest_points",
    "cotangent_laplacian",
    "decimate",
    "deformation_gradients",
    "face_normals",
    "prolongation",
    "rasterize_uv",
    "repair",
    "split_faces",
    "subdivide",
    "surface_correspondence",
    "transfer_operator",
    "triangle_frames",
    "vertex_masses",
    "vertex_normals",
]
