"""Subdivided surfaces of the default head's parts, and sky visibility on them."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int

from meshanim import geometry
from meshanim.geometry import bilinear_operator, catmull_clark_operator

__all__ = ["Surface", "sky_visibility", "subdivided_surface", "vertex_normals"]


@dataclass(frozen=True)
class Surface:
    """A part of the head after one Catmull-Clark step: linear in the head's vertices.

    Parameters
    ----------
    operator : (N, V) sparse float32
        Multiplies the head's vertices (V, 3) at any expression, shape and pose into this surface's vertices.
    faces : (F, 3) int32
        Triangles over the N vertices. Quad q of the subdivided part became triangles q and q + F / 2.
    corner_uv : (F, 3, 2) float32
        Texture coordinates of each triangle's corners; v points up, so row 0 of a texture is v = 1.
    island : (F,) int32
        Which connected piece of the texture layout a triangle lies in.
    """

    operator: sp.csr_array
    faces: Int[np.ndarray, "faces 3"]
    corner_uv: Float[np.ndarray, "faces 3 2"]
    island: Int[np.ndarray, " faces"]

    def vertices(self, head_vertices) -> Float[np.ndarray, "vertices 3"]:
        """The surface's vertices (N, 3) float32 for head vertices (V, 3)."""
        return self.operator @ np.asarray(head_vertices, np.float32)


def subdivided_surface(
    quads: Int[np.ndarray, "quads 4"],
    uv: Float[np.ndarray, "coordinates 2"],
    uv_quads: Int[np.ndarray, "quads 4"],
    n_vertices: int,
) -> Surface:
    """Subdivide a quad part once (Catmull-Clark; texture coordinates bilinearly) and cut it into triangles.

    Parameters
    ----------
    quads, uv_quads : (Q, 4) int
        Indices into the head's `n_vertices` vertices and into `uv`.
    uv : (U, 2) float
    n_vertices : int
        Number of vertices of the whole head.
    """
    used, local = np.unique(quads, return_inverse=True)
    local = local.reshape(-1, 4)
    select = sp.csr_array((np.ones(len(used)), (np.arange(len(used)), used)), (len(used), n_vertices))
    step, fine_quads = catmull_clark_operator(local, len(used))
    uv_step, fine_uv_quads = bilinear_operator(uv_quads, len(uv))
    fine_uv = uv_step @ uv
    operator = sp.csr_array(step @ select).astype(np.float32)
    operator.sort_indices()
    return Surface(
        operator,
        _triangles(fine_quads).astype(np.int32),
        fine_uv[_triangles(fine_uv_quads)].astype(np.float32),
        np.tile(np.repeat(_islands(uv_quads, len(uv)), 4), 2).astype(np.int32),
    )


def _triangles(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _islands(uv_quads: np.ndarray, n_uv: int) -> np.ndarray:
    """A number (Q,) a connected piece of the layout, the piece with most quads first."""
    rows, columns = uv_quads[:, [0, 1, 2]].ravel(), uv_quads[:, [1, 2, 3]].ravel()
    links = sp.coo_array((np.ones(len(rows)), (rows, columns)), (n_uv, n_uv))
    piece = sp.csgraph.connected_components(links, directed=False)[1][uv_quads[:, 0]]
    names, counts = np.unique(piece, return_counts=True)
    order = {int(name): rank for rank, name in enumerate(names[np.argsort(-counts, kind="stable")])}
    return np.array([order[int(name)] for name in piece])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "vertices 3"]:
    """Unit normals (N, 3), area weighted; float64."""
    normals = geometry.vertex_normals(
        torch.from_numpy(vertices.astype(float)), torch.from_numpy(faces.astype(np.int64))
    )
    return normals.numpy()


def sky_visibility(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    directions: int = 72,
    cell: float = 0.0011,
) -> Float[np.ndarray, " vertices"]:
    """Cosine-weighted share of the sky that each vertex sees, from orthographic depth maps of points.

    The surface is sampled more densely than the maps' cells, so no rasteriser is needed; the same input
    gives the same result bit by bit.

    Parameters
    ----------
    vertices, faces
        The surface, in metres.
    directions : int
        How many directions, spread by the Fibonacci spiral.
    cell : float
        Size of a depth cell, metres.
    """
    normals = vertex_normals(vertices, faces)
    samples = np.ascontiguousarray(_surface_samples(vertices, faces, 0.9 * cell).T, np.float32)
    index = np.arange(directions) + 0.5
    height, angle = 1 - 2 * index / directions, index * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    visible, weight = np.zeros(len(vertices)), np.zeros(len(vertices))
    lifted = vertices + 0.0015 * normals
    for direction in np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1):
        across = np.cross(direction, [0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        basis = np.stack([across, np.cross(direction, across), -direction], axis=1)
        seen = lifted @ basis
        low = seen.min(0)[:2] - 0.004
        width, rows = ((seen.max(0)[:2] + 0.004 - low) / cell).astype(int) + 1
        points = basis.T.astype(np.float32) @ samples
        column = ((points[0] - np.float32(low[0])) * np.float32(1 / cell)).astype(np.int32)
        row = ((points[1] - np.float32(low[1])) * np.float32(1 / cell)).astype(np.int32)
        depth = np.full(width * rows, np.inf, np.float32)
        np.minimum.at(depth, row * width + column, points[2])
        at = ((seen[:, :2] - low) / cell).astype(np.int64)
        facing = np.clip(normals @ direction, 0, None)
        visible += facing * (depth[at[:, 1] * width + at[:, 0]] > seen[:, 2] - 0.0012)
        weight += facing
    share = visible / np.maximum(weight, 1e-9)
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    links = sp.coo_array((np.ones(len(sides)), (sides[:, 0], sides[:, 1])), (len(vertices),) * 2).tocsr()
    links = links + links.T
    for _ in range(2):
        share = 0.5 * share + 0.5 * (links @ share) / np.maximum(links.sum(1), 1)
    return share.astype(np.float32)


def _surface_samples(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> np.ndarray:
    """Points on every triangle, no further apart than about `spacing`, the vertices included."""
    corners = vertices[faces].astype(float)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    steps = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    points = []
    for count in np.unique(steps):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        inside = i + j <= count
        weights = np.stack([i[inside], j[inside], count - i[inside] - j[inside]], axis=1) / count
        points.append((weights @ corners[steps == count]).reshape(-1, 3))
    return np.concatenate(points)
