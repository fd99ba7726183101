"""Rasterisation of a mesh's texture layout: which triangle, and where in it, each texel shows."""

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import MeshError, OptionError
from meshanim.geometry.mesh import TriangleMesh

__all__ = ["rasterize_uv"]

CANDIDATES_AT_ONCE = 1 << 22
"""Texel-triangle pairs tested in one pass; bounds the memory to some 400 MB."""


def rasterize_uv(
    mesh: TriangleMesh, size: int | tuple[int, int]
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width 3"]]:
    """Find the triangle under each texel centre of a texture image.

    Texel (row i, column j) of an image of height H and width W has its centre at u = (j + 0.5) / W,
    v = 1 - (i + 0.5) / H: row 0 is the top of the image. A centre on a shared edge, or in several
    overlapping triangles, belongs to the one of lowest index. Parts of the layout outside the unit square
    are not shown.

    Parameters
    ----------
    mesh : TriangleMesh
        With texture coordinates.
    size : int or (int, int)
        Height and width in texels.

    Returns
    -------
    face : (H, W) int
        Face index, -1 where no triangle is.
    barycentric : (H, W, 3) float
        Weights of the face's three corners, zero where no triangle is.

    Raises
    ------
    MeshError
        If the mesh has no texture coordinates.
    OptionError
        If the size is not positive.
    """
    if mesh.uv is None or mesh.uv_faces is None:
        raise MeshError("rasterize_uv needs texture coordinates: give TriangleMesh(uv=..., uv_faces=...)")
    height, width = (size, size) if isinstance(size, int) else size
    if height < 1 or width < 1:
        raise OptionError(f"size must be at least 1 x 1 texels, not {height} x {width}")

    # Texel space: x to the right, y down, centres of texels at integers.
    texel = np.stack([mesh.uv[:, 0] * width - 0.5, (1 - mesh.uv[:, 1]) * height - 0.5], axis=1)
    corners = texel[mesh.uv_faces]
    limit = np.array([width - 1, height - 1])
    low = np.maximum(np.ceil(corners.min(1) - 1e-9), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(1) + 1e-9), limit).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    count = extent.prod(1)

    face = np.full(height * width, -1, np.int64)
    barycentric = np.zeros((height * width, 3))
    for first, last in _passes(count):
        ids = np.repeat(np.arange(first, last), count[first:last])
        within = np.arange(len(ids)) - np.repeat(
            np.cumsum(count[first:last]) - count[first:last], count[first:last]
        )
        x = low[ids, 0] + within % extent[ids, 0]
        y = low[ids, 1] + within // extent[ids, 0]
        weights, inside = _barycentric(corners[ids], np.stack([x, y], axis=1).astype(float))
        texels, hit = (y * width + x)[inside], ids[inside]
        free = face[texels] < 0
        texels, hit, weights = texels[free], hit[free], weights[inside][free]
        texels, lowest = np.unique(texels, return_index=True)
        face[texels], barycentric[texels] = hit[lowest], weights[lowest]
    return face.reshape(height, width), barycentric.reshape(height, width, 3)


def _passes(count: np.ndarray):
    """Ranges of faces whose candidate texels fit one pass."""
    ends = np.cumsum(count)
    first = 0
    while first < len(count):
        done = ends[first] - count[first]
        last = max(int(np.searchsorted(ends, done + CANDIDATES_AT_ONCE, side="right")), first + 1)
        yield first, last
        first = last


def _barycentric(corners: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (N, 3) of each point in its triangle (N, 3, 2), and whether it lies inside."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = _cross(b - a, c - a)
    solid = np.abs(area) > 1e-12
    safe = np.where(solid, area, 1.0)
    weights = np.stack(
        [_cross(b - points, c - points) / safe, _cross(c - points, a - points) / safe, np.zeros(len(points))],
        axis=1,
    )
    weights[:, 2] = 1 - weights[:, 0] - weights[:, 1]
    return np.clip(weights, 0, 1), solid & (weights >= -1e-9).all(1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
