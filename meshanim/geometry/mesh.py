"""`TriangleMesh`: topology and rest geometry, with operators computed once and kept."""

from functools import cached_property

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from meshanim.errors import MeshError, ShapeError

__all__ = ["TriangleMesh"]


class TriangleMesh:
    """A triangle mesh in metres, y up; float64 vertices, int64 faces, counter-clockwise seen from outside.

    Parameters
    ----------
    vertices : (V, 3) float
        Positions in metres.
    faces : (F, 3) int
        Vertex indices.
    uv : (U, 2) float, optional
        Texture coordinates, origin at the lower left.
    uv_faces : (F, 3) int, optional
        Indices into `uv`; `faces` itself when `uv` has a row a vertex.

    Raises
    ------
    ShapeError
        If an array has the wrong shape, a vertex is NaN or infinite, or `uv_faces` is missing.
    MeshError
        If a face names a vertex that does not exist or repeats one.
    """

    def __init__(self, vertices, faces, uv=None, uv_faces=None):
        self.vertices: Float[np.ndarray, "vertices 3"] = _rows(vertices, 3, np.float64, "vertices")
        self.faces: Int[np.ndarray, "faces 3"] = _rows(faces, 3, np.int64, "faces")
        if not np.isfinite(self.vertices).all():
            bad = np.flatnonzero(~np.isfinite(self.vertices).all(1))
            raise ShapeError(f"vertices: {len(bad)} rows are NaN or infinite, the first is row {bad[0]}")
        _check_indices(self.faces, len(self.vertices), "faces", "vertices")
        repeated = (self.faces == np.roll(self.faces, 1, axis=1)).any(1)
        if repeated.any():
            raise MeshError(
                f"faces: {repeated.sum()} triangles name a vertex twice, the first is face "
                f"{np.flatnonzero(repeated)[0]}; remove them with meshanim.geometry.repair"
            )
        self.uv = None if uv is None else _rows(uv, 2, np.float64, "uv")
        self.uv_faces = None
        if self.uv is not None:
            if uv_faces is None and len(self.uv) != len(self.vertices):
                raise ShapeError(f"uv has {len(self.uv)} rows, vertices {len(self.vertices)}: give uv_faces")
            self.uv_faces = self.faces if uv_faces is None else _rows(uv_faces, 3, np.int64, "uv_faces")
            if len(self.uv_faces) != len(self.faces):
                raise ShapeError(f"uv_faces has {len(self.uv_faces)} rows, faces {len(self.faces)}")
            _check_indices(self.uv_faces, len(self.uv), "uv_faces", "uv")

    @property
    def n_vertices(self) -> int:
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        return len(self.faces)

    @cached_property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """Undirected edges, each once, smaller index first, sorted."""
        pairs = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return np.unique(pairs, axis=0)

    @cached_property
    def adjacency(self) -> sp.csr_array:
        """Symmetric (V, V) matrix of ones where two vertices share an edge; sorted CSR, empty diagonal."""
        edges, n = self.edges, self.n_vertices
        rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
        matrix = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
        matrix.sort_indices()
        return matrix

    def with_vertices(self, vertices) -> "TriangleMesh":
        """The same topology and texture coordinates at other positions."""
        return TriangleMesh(vertices, self.faces, self.uv, self.uv_faces)

    def __repr__(self) -> str:
        texture = "" if self.uv is None else f", {len(self.uv)} texture coordinates"
        return f"TriangleMesh({self.n_vertices} vertices, {self.n_faces} faces{texture})"


def _rows(array, columns: int, dtype, name: str) -> np.ndarray:
    array = np.asarray(array)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ShapeError(f"{name} must have shape (n, {columns}), not {array.shape}")
    if dtype is np.int64 and not np.issubdtype(array.dtype, np.integer):
        raise ShapeError(f"{name} must be integers, not {array.dtype}")
    return np.ascontiguousarray(array, dtype)


def _check_indices(faces: np.ndarray, size: int, name: str, target: str) -> None:
    if faces.size and (faces.min() < 0 or faces.max() >= size):
        raise MeshError(f"{name} name {target} {faces.min()}..{faces.max()}, but there are {size}")
