"""Carrying what lives on the vertices of one mesh to points of another."""

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from meshanim.errors import ShapeError
from meshanim.geometry.closest_points import closest_points
from meshanim.geometry.mesh import TriangleMesh

__all__ = ["SparseOperator", "barycentric_operator", "carry", "transfer_operator"]


def transfer_operator(mesh: TriangleMesh, points: Float[np.ndarray, "points 3"]) -> sp.csr_array:
    """Sparse (n, V) matrix that interpolates values of a mesh's vertices at the closest surface points.

    Rows are barycentric weights: not negative, at most three, sum to one. Functions that are linear in
    space are reproduced at points of the surface.

    Parameters
    ----------
    mesh : TriangleMesh
        Where the values live.
    points : (n, 3) float
        Where they are wanted, in metres: for example the vertices of another mesh, aligned to this one.

    Raises
    ------
    MeshError
        If the mesh has no faces.
    ShapeError
        If a point is NaN or infinite.
    """
    found = closest_points(mesh, points)
    return barycentric_operator(mesh.faces[found.face], found.barycentric, mesh.n_vertices)


def barycentric_operator(
    corners: Int[np.ndarray, "points 3"], weights: Float[np.ndarray, "points 3"], n_vertices: int
) -> sp.csr_array:
    """Sparse (n, V) matrix with the given weights at the given corners; zeros are left out."""
    rows = np.repeat(np.arange(len(corners)), 3)
    shape = (len(corners), n_vertices)
    operator = sp.csr_array((weights.ravel(), (rows, corners.ravel())), shape=shape)
    operator.eliminate_zeros()
    operator.sort_indices()
    return operator


def carry(operator: sp.csr_array, values: np.ndarray) -> np.ndarray:
    """Apply an operator to values with vertices on the last axis but one, such as frames or blendshapes.

    Parameters
    ----------
    operator : (n, V) sparse
        From `transfer_operator`, `decimate`, `subdivide`, ...
    values : (V,) or (..., V, C) float
        A scalar per vertex, or vectors: (V, 3) positions, (T, V, 3) an animation, (K, V, 3) blendshapes.

    Returns
    -------
    (n,) or (..., n, C) float
        In the floating-point type of `values`.

    Raises
    ------
    ShapeError
        If the values are not of V vertices.
    """
    values = np.asarray(values)
    n, n_vertices = operator.shape
    axis = 0 if values.ndim == 1 else values.ndim - 2
    if values.ndim == 0 or values.shape[axis] != n_vertices:
        raise ShapeError(f"values of {n_vertices} vertices needed on axis {axis}, got shape {values.shape}")
    dtype = np.result_type(values.dtype, np.float32)
    first = np.moveaxis(values, axis, 0)
    carried = operator.astype(dtype) @ first.reshape(n_vertices, -1).astype(dtype, copy=False)
    return np.ascontiguousarray(np.moveaxis(carried.reshape(n, *first.shape[1:]), 0, axis))


class SparseOperator(nn.Module):
    """A fixed sparse matrix inside a network: (..., V, C) to (..., n, C), on any device and in any precision.

    Each row's entries are gathered one after another, so the cost is that of the fullest row; operators of
    barycentric weights have at most three.

    Parameters
    ----------
    operator : (n, V) sparse
        Not learnt; left out of checkpoints, since the mesh it came from makes it again.
    """

    columns: Int[Tensor, "rows entries"]
    weights: Float[Tensor, "rows entries"]

    def __init__(self, operator: sp.csr_array):
        super().__init__()
        self.n_columns = operator.shape[1]
        counts = np.diff(operator.indptr)
        filled = np.arange(counts.max(initial=1)) < counts[:, None]
        columns, weights = np.zeros(filled.shape, np.int64), np.zeros(filled.shape, np.float32)
        columns[filled], weights[filled] = operator.indices, operator.data
        self.register_buffer("columns", torch.from_numpy(columns), persistent=False)
        self.register_buffer("weights", torch.from_numpy(weights), persistent=False)

    def forward(
        self, values: Float[Tensor, "*batch columns channels"]
    ) -> Float[Tensor, "*batch rows channels"]:
        if values.shape[-2] != self.n_columns:
            raise ShapeError(f"values of {self.n_columns} vertices needed, got shape {tuple(values.shape)}")
        weights = self.weights.to(values.dtype)
        out = values.new_zeros(*values.shape[:-2], len(weights), values.shape[-1])
        for entry in range(weights.shape[1]):
            out = out + weights[:, entry, None] * values.index_select(-2, self.columns[:, entry])
        return out
