"""What the faces alone say of a mesh: edges and their uses, boundary, components, manifoldness."""

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Int

from meshanim.errors import MeshError

__all__ = [
    "boundary_edges",
    "boundary_loops",
    "edge_uses",
    "is_consistently_oriented",
    "is_manifold",
    "vertex_components",
]

Faces = Int[np.ndarray, "faces 3"]


def edge_uses(faces: Faces) -> tuple[Int[np.ndarray, "edges 2"], Int[np.ndarray, "faces 3"]]:
    """Undirected edges, and the edge of each side of each face.

    Returns
    -------
    edges : (E, 2) int
        Each once, smaller index first, sorted.
    edge_of_side : (F, 3) int
        Side k of a face runs from its corner k to corner k + 1.
    """
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    edges, edge_of_side = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    return edges.reshape(-1, 2), edge_of_side.reshape(-1, 3)


def boundary_edges(faces: Faces) -> Int[np.ndarray, "boundary 2"]:
    """Edges of one face only, in the direction in which that face runs along them."""
    edges, edge_of_side = edge_uses(faces)
    alone = np.bincount(edge_of_side.ravel(), minlength=len(edges))[edge_of_side] == 1
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    return sides[alone]


def boundary_loops(faces: Faces) -> list[np.ndarray]:
    """Closed loops of boundary vertices, the longest first, in the direction of the faces beside them.

    Raises
    ------
    MeshError
        If a boundary vertex has more than one boundary edge leaving it (two boundaries touch there, or the
        faces beside it run against each other).
    """
    directed = boundary_edges(faces)
    starts, counts = np.unique(directed[:, 0], return_counts=True)
    if (counts > 1).any() or not np.array_equal(starts, np.unique(directed[:, 1])):
        raise MeshError(
            "the boundary is not a set of simple loops: boundaries touch in a vertex, or faces are not "
            "consistently oriented; mend the mesh with meshanim.geometry.repair"
        )
    following = dict(directed.tolist())
    loops = []
    while following:
        loop = [next(iter(following))]
        while (after := following.pop(loop[-1])) != loop[0]:
            loop.append(after)
        loops.append(np.array(loop))
    return sorted(loops, key=len, reverse=True)


def vertex_components(faces: Faces, n_vertices: int) -> Int[np.ndarray, " vertices"]:
    """Label of the connected component of each vertex, from 0 in order of first vertex."""
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = sp.csr_array((np.ones(len(pairs)), pairs.T), shape=(n_vertices, n_vertices))
    _, labels = sp.csgraph.connected_components(graph, directed=False)
    _, first, labels = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[labels.ravel()]


def is_manifold(faces: Faces, n_vertices: int) -> Bool[np.ndarray, " vertices"]:
    """Whether the faces around each vertex form one fan or one closed ring; unused vertices count as such."""
    edges, edge_of_side = edge_uses(faces)
    crowded = np.bincount(edge_of_side.ravel(), minlength=len(edges)) > 2
    good = np.ones(n_vertices, bool)
    good[edges[crowded].ravel()] = False
    used = np.zeros(n_vertices, bool)
    used[faces.ravel()] = True
    if used.any():
        single_fan = np.ones(n_vertices, bool)
        last = int(faces.max()) + 1
        single_fan[:last] = igl.is_vertex_manifold(faces)[:last]
        good &= single_fan | ~used
    return good


def is_consistently_oriented(faces: Faces) -> bool:
    """Whether no two faces run along an edge in the same direction."""
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    return len(np.unique(sides, axis=0)) == len(sides)
