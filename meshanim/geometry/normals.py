"""Normals of moving meshes: batched, differentiable, defined on degenerate triangles."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["area_vectors", "face_normals", "vertex_normals"]


def area_vectors(
    vertices: Float[Tensor, "*batch vertices 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "*batch faces 3"]:
    """Normal of each face times its area in m²."""
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    return 0.5 * torch.linalg.cross(b - a, c - a)


def face_normals(
    vertices: Float[Tensor, "*batch vertices 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "*batch faces 3"]:
    """Unit normals of the faces; zero, with zero gradient, for a face without area."""
    return _unit_or_zero(area_vectors(vertices, faces))


def vertex_normals(
    vertices: Float[Tensor, "*batch vertices 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "*batch vertices 3"]:
    """Unit normals of the vertices, faces weighted by area; zero where they cancel or there are none."""
    weighted = area_vectors(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(-2, faces[:, corner], weighted)
    return _unit_or_zero(total)


def _unit_or_zero(vectors: Tensor) -> Tensor:
    square = (vectors * vectors).sum(-1, keepdim=True)
    solid = square > torch.finfo(vectors.dtype).tiny
    return torch.where(solid, vectors * torch.where(solid, square, 1.0).rsqrt(), 0.0)
