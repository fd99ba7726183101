"""Texture coordinates of a decimated mesh whose layout has seams."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from meshanim.geometry.closest_points import barycentric_coordinates
from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.topology import edge_uses

__all__ = ["decimated_texture"]


def decimated_texture(
    mesh: TriangleMesh,
    cluster: Int[np.ndarray, " vertices"],
    positions: Float[np.ndarray, "new 3"],
    faces: Int[np.ndarray, "new_faces 3"],
) -> tuple[Float[np.ndarray, "texture 2"], Int[np.ndarray, "new_faces 3"]]:
    """Carry a texture layout to a mesh of fewer triangles, by closest points on one side of every seam.

    The old triangles around a new one, those with a corner that was merged into one of its corners, are
    joined where they share a side in the layout; what holds the point closest to the new triangle's centre
    is the piece it takes all three corners from. A new triangle that lies across a seam so belongs to one
    side of it.

    Parameters
    ----------
    mesh : TriangleMesh
        Before, with texture coordinates.
    cluster : (V,) int
        The new vertex of each old one, -1 for none.
    positions : (v, 3)
        New vertices, on the old surface.
    faces : (f, 3) int
        New triangles.

    Returns
    -------
    uv : (u, 2)
        One row for each new vertex and side of a seam.
    uv_faces : (f, 3) int
    """
    assert mesh.uv is not None
    assert mesh.uv_faces is not None
    row, face = _neighbourhoods(mesh, cluster, faces)
    centre = positions[faces].mean(1)[row]
    distance, base_uv = _closest(mesh, face, centre)
    first = _first_of_each(row, distance)
    piece = _pieces(mesh, row, face, len(faces))
    same = piece == piece[first][row]
    base_uv = base_uv[first]
    size = float(np.ptp(mesh.vertices, axis=0).max())
    corners = np.empty((len(faces), 3, 2))
    for corner in range(3):
        vertex = faces[row, corner]
        around = same & (cluster[mesh.faces[face]] == vertex[:, None]).any(1)
        without = np.bincount(row[around], minlength=len(faces)) == 0
        taken = np.flatnonzero(around | (same & without[row]))
        distance, uv = _closest(mesh, face[taken], positions[vertex[taken]])
        # On the seam itself both of its sides are closest: the one nearer in the layout is meant.
        beside = np.linalg.norm(uv - base_uv[row[taken]], axis=1)
        corners[:, corner] = uv[_first_of_each(row[taken], np.round(distance / (1e-9 * size)), beside)]
    rows = np.concatenate([faces.reshape(-1, 1), np.round(corners.reshape(-1, 2), 9)], axis=1)
    _, index, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return corners.reshape(-1, 2)[index], inverse.reshape(-1, 3)


def _neighbourhoods(
    mesh: TriangleMesh, cluster: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a new triangle and an old one around it, sorted by the new one."""
    owner, old = cluster[mesh.faces].ravel(), np.repeat(np.arange(mesh.n_faces), 3)
    touching = sp.csr_array((np.ones(len(owner)), (owner, old)), shape=(cluster.max() + 1, mesh.n_faces))
    new = np.repeat(np.arange(len(faces)), 3)
    member = sp.csr_array((np.ones(len(new)), (new, faces.ravel())), shape=(len(faces), cluster.max() + 1))
    pairs = (member @ touching).tocoo()
    order = np.lexsort((pairs.coords[1], pairs.coords[0]))
    return pairs.coords[0][order], pairs.coords[1][order]


def _pieces(mesh: TriangleMesh, row: np.ndarray, face: np.ndarray, n_rows: int) -> np.ndarray:
    """A label for each pair, the same where old triangles of one new one join in the layout."""
    assert mesh.uv_faces is not None
    _, uses = edge_uses(mesh.uv_faces)
    side, owner = uses.ravel(), np.repeat(np.arange(mesh.n_faces), 3)
    order = np.argsort(side, kind="stable")
    joined = np.flatnonzero(side[order][1:] == side[order][:-1])
    one, other = owner[order[joined]], owner[order[joined + 1]]
    numbered = sp.csc_array((np.arange(1, len(row) + 1), (row, face)), shape=(n_rows, mesh.n_faces))
    left, right = numbered[:, one], numbered[:, other]
    both_left = left.multiply(right.astype(bool)).tocoo()
    both_right = right.multiply(left.astype(bool)).tocoo()
    graph = sp.coo_array(
        (np.ones(both_left.nnz), (_in_order(both_left) - 1, _in_order(both_right) - 1)),
        shape=(len(row), len(row)),
    )
    return sp.csgraph.connected_components(graph, directed=False)[1]


def _in_order(matrix: sp.coo_array) -> np.ndarray:
    return matrix.data[np.lexsort(matrix.coords)]


def _closest(mesh: TriangleMesh, face: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each point to its face, and the texture coordinates there."""
    assert mesh.uv is not None
    assert mesh.uv_faces is not None
    corners = mesh.vertices[mesh.faces[face]]
    weights = barycentric_coordinates(points, corners)
    distance = np.linalg.norm(np.einsum("nk,nkd->nd", weights, corners) - points, axis=1)
    return distance, np.einsum("nk,nkd->nd", weights, mesh.uv[mesh.uv_faces[face]])


def _first_of_each(row: np.ndarray, *keys: np.ndarray) -> np.ndarray:
    """Position of the smallest entry of each row, by the first key, then the next."""
    order = np.lexsort((*reversed(keys), row))
    return order[np.searchsorted(row[order], np.arange(row.max() + 1))]
