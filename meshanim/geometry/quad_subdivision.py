"""Subdivision of quadrilateral meshes, one step at a time, as sparse matrices on per-vertex values.

An operator S of shape (new vertices, old vertices) carries positions, blendshapes, normals' sources,
weights or a whole animation: `S @ values`. Rows sum to one.
"""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Int

from meshanim.errors import MeshError, ShapeError
from meshanim.geometry.stencils import averages, incidence, rows_where, scaled, tidy

__all__ = ["bilinear_operator", "catmull_clark_operator"]


def catmull_clark_operator(
    quads: Int[np.ndarray, "quads 4"],
    n_vertices: int,
    creases: Int[np.ndarray, "creases 2"] | None = None,
) -> tuple[sp.csr_array, Int[np.ndarray, "new_quads 4"]]:
    """One Catmull-Clark step (Catmull and Clark 1978) as a sparse matrix.

    Boundary edges, edges of three or more quads and `creases` are subdivided as cubic B-spline curves; a
    vertex where other than two of them meet stays where it is, as does a vertex that no quad uses.

    Parameters
    ----------
    quads : (Q, 4) int
        Vertex indices, in order around each quad.
    n_vertices : int
        Number of old vertices.
    creases : (C, 2) int, optional
        Interior edges to keep sharp, by their vertex indices.

    Returns
    -------
    operator : (V + E + Q, V) sparse
        Rows in this order: old vertices, edges (sorted by their vertex pair), quads.
    quads : (4 Q, 4) int
        Quads 4 i to 4 i + 3 lie in old quad i, at its corners in turn; each starts at the old corner and
        keeps the old orientation.

    Raises
    ------
    MeshError
        If a quad repeats a vertex or names one that does not exist, or a crease is not an edge.
    """
    edges, edge_of_side, new_quads = _split_quads(quads, n_vertices)
    n_edges = len(edges)
    face_points, midpoints = averages(quads, n_vertices), averages(edges, n_vertices)
    faces_of_edge = incidence(edge_of_side, n_edges)
    uses = np.bincount(edge_of_side.ravel(), minlength=n_edges)
    sharp = uses != 2
    if creases is not None:
        sharp |= _marked_edges(edges, creases, n_vertices)

    smooth_edge_points = 0.5 * midpoints + 0.25 * (faces_of_edge @ face_points)
    edge_points = rows_where(sharp, midpoints, smooth_edge_points)

    faces_of_vertex, edges_of_vertex = incidence(quads, n_vertices), incidence(edges, n_vertices)
    valence = np.maximum(edges_of_vertex.sum(1), 1)
    face_valence = np.maximum(faces_of_vertex.sum(1), 1)
    n_sharp = edges_of_vertex @ sharp.astype(float)
    unused = edges_of_vertex.sum(1) == 0
    smooth = (
        scaled(1 / (valence * face_valence), faces_of_vertex @ face_points)
        + scaled(2 / valence**2, edges_of_vertex @ midpoints)
        + sp.diags_array((valence - 3) / valence)
    )
    curve = scaled(
        np.full(n_vertices, 0.25), edges_of_vertex @ scaled(sharp.astype(float), midpoints)
    ) + 0.5 * sp.diags_array(np.ones(n_vertices))
    on_curve = n_sharp == 2
    fixed = unused | ((n_sharp > 0) & ~on_curve)
    vertex_points = rows_where(
        fixed, sp.diags_array(np.ones(n_vertices)), rows_where(on_curve, curve, smooth)
    )

    return tidy(sp.vstack([vertex_points, edge_points, face_points]).tocsr()), new_quads


def bilinear_operator(
    quads: Int[np.ndarray, "quads 4"], n_vertices: int
) -> tuple[sp.csr_array, Int[np.ndarray, "new_quads 4"]]:
    """One bilinear step: old vertices stay, edges get their midpoint, quads their centroid.

    The quads come out in the order of `catmull_clark_operator`, so a texture layout subdivided by this
    fits the surface subdivided by that.

    Parameters
    ----------
    quads : (Q, 4) int
        Indices of texture coordinates (or of vertices), in order around each quad.
    n_vertices : int
        Number of old texture coordinates.

    Returns
    -------
    operator : (V + E + Q, V) sparse
        Rows: old vertices, edges (sorted by their vertex pair), quads.
    quads : (4 Q, 4) int
        Four quads for each old one, as in `catmull_clark_operator`.

    Raises
    ------
    MeshError
        If a quad repeats a vertex or names one that does not exist.
    """
    edges, _, new_quads = _split_quads(quads, n_vertices)
    identity = sp.diags_array(np.ones(n_vertices))
    blocks = [identity, averages(edges, n_vertices), averages(quads, n_vertices)]
    return tidy(sp.vstack(blocks).tocsr()), new_quads


def _split_quads(quads: np.ndarray, n_vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (E, 2), the edge of each side (Q, 4; side k runs from corner k to k + 1), the new quads."""
    if quads.ndim != 2 or quads.shape[1] != 4:
        raise ShapeError(f"quads must have shape (n, 4), not {quads.shape}")
    if quads.size and (quads.min() < 0 or quads.max() >= n_vertices):
        raise MeshError(f"quads name vertices {quads.min()}..{quads.max()}, but there are {n_vertices}")
    ordered = np.sort(quads, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(1))
    if len(repeated):
        raise MeshError(f"{len(repeated)} quads name a vertex twice, the first is quad {repeated[0]}")
    sides = np.stack([quads, np.roll(quads, -1, axis=1)], axis=2)
    edges, edge_of_side = np.unique(np.sort(sides.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    edge_of_side = edge_of_side.reshape(-1, 4)
    centre = n_vertices + len(edges) + np.arange(len(quads))
    after = n_vertices + edge_of_side
    corners = [quads, after, np.repeat(centre[:, None], 4, axis=1), np.roll(after, 1, axis=1)]
    return edges, edge_of_side, np.stack(corners, axis=2).reshape(-1, 4)


def _marked_edges(edges: np.ndarray, marked: np.ndarray, n_vertices: int) -> np.ndarray:
    keys = edges[:, 0] * n_vertices + edges[:, 1]
    ordered = np.sort(marked, axis=1)
    wanted = ordered[:, 0] * n_vertices + ordered[:, 1]
    unknown = np.flatnonzero(~np.isin(wanted, keys))
    if len(unknown):
        raise MeshError(f"crease {tuple(marked[unknown[0]].tolist())} is not an edge of the mesh")
    return np.isin(keys, wanted)
