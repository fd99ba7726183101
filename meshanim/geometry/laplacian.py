"""The discrete Laplace-Beltrami operator and its eigenfunctions."""

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.linalg import eigsh

from meshanim.errors import MeshError, OptionError

__all__ = ["cotangent_laplacian", "eigenbasis", "vertex_masses", "zero_area_faces"]

DENSE_BELOW = 200
"""Meshes with fewer vertices are diagonalised as dense matrices, where Lanczos gains nothing."""

Vertices = Float[np.ndarray, "vertices 3"]
Faces = Int[np.ndarray, "faces 3"]


def zero_area_faces(vertices: Vertices, faces: Faces) -> Int[np.ndarray, " degenerate"]:
    """Indices of faces whose height is below 1e-10 of their longest side."""
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    double_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return np.flatnonzero(double_area <= 1e-10 * (sides**2).sum(2).max(1, initial=0.0))


def cotangent_laplacian(vertices: Vertices, faces: Faces) -> sp.csr_array:
    """Cotangent Laplacian with the sign that makes it positive semi-definite (minus libigl's).

    Symmetric, rows sum to zero; `x @ L @ x` is the Dirichlet energy, the integral of the squared gradient
    of the piecewise linear function x. Boundaries carry the natural (Neumann) condition.

    Raises
    ------
    MeshError
        If a face has no area.
    """
    _refuse_zero_area(vertices, faces)
    matrix = sp.csr_array(-igl.cotmatrix(vertices, faces), shape=(len(vertices), len(vertices)))
    matrix.sort_indices()
    return matrix


def vertex_masses(vertices: Vertices, faces: Faces) -> sp.csr_array:
    """Diagonal (V, V) matrix of the area that belongs to each vertex (hybrid Voronoi cells), in m²."""
    _refuse_zero_area(vertices, faces)
    diagonal = np.zeros(len(vertices))
    cells = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    diagonal[: len(cells)] = cells
    return sp.diags_array(diagonal).tocsr()


def eigenbasis(
    laplacian: sp.csr_array, mass: sp.csr_array, k: int
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "vertices k"]]:
    """The k smoothest solutions of L x = λ M x.

    Parameters
    ----------
    laplacian, mass : (V, V) sparse
        Positive semi-definite cotangent Laplacian, positive diagonal mass.
    k : int
        How many, 1 to V.

    Returns
    -------
    eigenvalues : (k,) float
        In 1/m², ascending; zero once for each component of the mesh.
    eigenvectors : (V, k) float
        Orthonormal in the mass: `vectors.T @ mass @ vectors` is the identity. The entry of largest
        magnitude of each is positive. Where eigenvalues repeat, as on symmetric meshes, rounding chooses the
        basis of their space, and with it the number of threads.

    Raises
    ------
    OptionError
        If k is not in 1..V.
    MeshError
        If a vertex belongs to no face, and so has no mass.
    """
    n = laplacian.shape[0]
    if not 1 <= k <= n:
        raise OptionError(f"k must be 1 to the number of vertices {n}, not {k}")
    area = mass.diagonal()
    if (area <= 0).any():
        raise MeshError(
            f"{(area <= 0).sum()} vertices belong to no face, the first is {np.flatnonzero(area <= 0)[0]}; "
            "remove them with meshanim.geometry.repair"
        )
    # With y = M^(1/2) x the problem is an ordinary symmetric one.
    root = sp.diags_array(1 / np.sqrt(area))
    symmetric = (root @ laplacian @ root).tocsc()
    if n < DENSE_BELOW or k > n // 2:
        values, vectors = np.linalg.eigh(symmetric.toarray())
        values, vectors = values[:k], vectors[:, :k]
    else:
        start = np.random.default_rng(0).standard_normal(n)
        values, vectors = eigsh(symmetric, k=k, sigma=-1.0 / area.sum(), which="LM", v0=start)
        order = np.argsort(values)
        values, vectors = values[order], vectors[:, order]
    vectors = root @ vectors
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(0)[None], axis=0)
    return np.maximum(values, 0.0), vectors * np.where(largest < 0, -1.0, 1.0)


def _refuse_zero_area(vertices: np.ndarray, faces: np.ndarray) -> None:
    flat = zero_area_faces(vertices, faces)
    if len(flat):
        raise MeshError(
            f"{len(flat)} triangles have no area, the first is face {flat[0]}; remove them with "
            "meshanim.geometry.repair"
        )
