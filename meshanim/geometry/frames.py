"""The frame of each triangle: what moves things bound to a moving mesh."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["TriangleFrames", "triangle_frames"]


class TriangleFrames(NamedTuple):
    """Rotation, scale and origin of each triangle; a local x lies at `scale * rotation @ x + origin`."""

    rotation: Float[Tensor, "*batch faces 3 3"]
    """Columns: along the first side, normal, in the plane across the first side. Always a rotation."""
    scale: Float[Tensor, "*batch faces"]
    """Mean of first side and height over it, in metres; zero only where the triangle is a point."""
    origin: Float[Tensor, "*batch faces 3"]
    """Centroid, in metres."""


def triangle_frames(
    vertices: Float[Tensor, "*batch vertices 3"], faces: Int[Tensor, "faces 3"]
) -> TriangleFrames:
    """Frames of triangles (v0, v1, v2) in the convention of GaussianAvatars (Qian et al. 2024, Sec. 3.2).

    With n(x) = x / |x|: a0 = n(v1 - v0), a1 = n(a0 x (v2 - v0)) the face normal, a2 = a0 x a1,
    R = [a0 | a1 | a2], k = (|v1 - v0| + |a2 . (v2 - v0)|) / 2, T = (v0 + v1 + v2) / 3.

    A triangle without area still gets a rotation: the first side points along v2 - v0 if v0 = v1, along x
    if all three coincide; the normal is the coordinate axis least along the first side, made orthogonal to
    it. Gradients are finite everywhere.

    Parameters
    ----------
    vertices : (..., V, 3) float
        Metres.
    faces : (F, 3) int
        Vertex indices.

    Returns
    -------
    TriangleFrames
        rotation (..., F, 3, 3), scale (..., F), origin (..., F, 3).
    """
    v0, v1, v2 = (vertices[..., faces[:, corner], :] for corner in range(3))
    side, other = v1 - v0, v2 - v0
    smallest = torch.finfo(vertices.dtype).tiny ** 0.5

    has_side = _square(side) > smallest
    has_other = _square(other) > smallest
    x_axis = vertices.new_tensor([1.0, 0.0, 0.0]).expand_as(side)
    a0 = _unit(torch.where(has_side, side, torch.where(has_other, other, x_axis)))

    normal = torch.linalg.cross(a0, other)
    # The sine of the angle between the sides, against its rounding error.
    has_normal = has_other & (_square(normal) > (16 * torch.finfo(vertices.dtype).eps) ** 2 * _square(other))
    least = torch.nn.functional.one_hot(a0.detach().abs().argmin(-1), 3).to(vertices.dtype)
    across = least - (least * a0).sum(-1, keepdim=True) * a0
    a1 = _unit(torch.where(has_normal, normal, across))
    a2 = torch.linalg.cross(a0, a1)

    length = torch.where(has_side, _square(torch.where(has_side, side, x_axis)).sqrt(), 0.0)
    height = (a2 * other).sum(-1).abs()
    return TriangleFrames(torch.stack([a0, a1, a2], -1), 0.5 * (length[..., 0] + height), (v0 + v1 + v2) / 3)


def _square(vectors: Tensor) -> Tensor:
    return (vectors * vectors).sum(-1, keepdim=True)


def _unit(vectors: Tensor) -> Tensor:
    return vectors * _square(vectors).rsqrt()
