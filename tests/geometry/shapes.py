"""Meshes whose geometry is known in closed form."""

import numpy as np
import trimesh
from hypothesis import strategies as st

from meshanim.geometry import TriangleMesh


def from_trimesh(mesh: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces))


def sphere(subdivisions: int = 3, radius: float = 1.0) -> TriangleMesh:
    return from_trimesh(trimesh.creation.icosphere(subdivisions, radius))


def torus(major: float = 1.0, minor: float = 0.4) -> TriangleMesh:
    return from_trimesh(trimesh.creation.torus(major, minor, major_sections=24, minor_sections=12))


def plane(n: int = 8, jitter: float = 0.0, seed: int = 0) -> TriangleMesh:
    """The unit square in n x n cells cut in two, inner vertices moved at random within the plane."""
    y, x = np.mgrid[0 : n + 1, 0 : n + 1] / n
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    inside = ((vertices[:, :2] > 0) & (vertices[:, :2] < 1)).all(1)
    vertices[inside, :2] += np.random.default_rng(seed).uniform(-jitter / n, jitter / n, (inside.sum(), 2))
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return TriangleMesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def union(*meshes: TriangleMesh) -> TriangleMesh:
    offsets = np.cumsum([0] + [mesh.n_vertices for mesh in meshes])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return TriangleMesh(vertices, np.concatenate([m.faces + o for m, o in zip(meshes, offsets)]))


def moved(mesh: TriangleMesh, offset: tuple[float, float, float]) -> TriangleMesh:
    return mesh.with_vertices(mesh.vertices + np.array(offset))


def bow_tie() -> TriangleMesh:
    """Two triangles that share one vertex only."""
    return TriangleMesh([[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0.0]], [[0, 2, 1], [0, 3, 4]])


def three_pages() -> TriangleMesh:
    """Three triangles on one edge."""
    return TriangleMesh(
        [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0.0]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]]
    )


def collapsed() -> TriangleMesh:
    """A square whose second triangle has three vertices on a line."""
    return TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0.0]], [[0, 1, 2], [0, 1, 3]])


def rotations() -> st.SearchStrategy[np.ndarray]:
    """Rotation matrices from random quaternions."""

    def matrix(seed: int) -> np.ndarray:
        q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
        q = q * np.sign(np.diag(r))
        return q * np.array([1, 1, np.linalg.det(q)])

    return st.integers(0, 2**32 - 1).map(matrix)
