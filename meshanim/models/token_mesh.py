"""Tokens on a mesh: a subset of its vertices, dense where it matters, with a prolongation to all of them."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra

from meshanim.errors import OptionError
from meshanim.geometry import TriangleMesh

__all__ = ["TokenMesh", "choose_tokens"]

NEIGHBOURS = 8
"""Tokens that a vertex between them is interpolated from."""
ROUNDS = 3
"""Rounds in which tokens are added where motion is missed."""


@dataclass(frozen=True)
class TokenMesh:
    """Some vertices of a mesh, who neighbours whom among them, and how their values spread.

    Parameters
    ----------
    vertices : (N,) int
        The tokens, as vertices of the mesh, ascending.
    edges : (E, 2) int
        Pairs of tokens whose cells touch: the cell of a token are the vertices closest to it.
    prolongation : (V, N) sparse
        Values of the tokens to values of all vertices; exact at the tokens and for affine motion.
    """

    vertices: Int[np.ndarray, " tokens"]
    edges: Int[np.ndarray, "edges 2"]
    prolongation: sp.csr_array


def choose_tokens(
    mesh: TriangleMesh, count: int, motion: Float[np.ndarray, "examples vertices 3"] | None = None
) -> TokenMesh:
    """Spread `count` tokens over a mesh, farthest point after farthest point along its surface.

    Distances are measured along edges, so that lips that touch and eyelids over eyes stay apart. With
    examples of motion, half of the tokens are spread with distances stretched where much moves, and the other
    half goes, in rounds, to the vertices whose motion the tokens so far reproduce worst.

    Parameters
    ----------
    mesh : TriangleMesh
        Any topology.
    count : int
        Tokens: from four a connected part to the number of vertices.
    motion : (M, V, 3), optional
        Displacements, metres: blendshapes, principal components or frames.

    Raises
    ------
    OptionError
        If `count` is out of range for the mesh and its parts.
    """
    n = mesh.n_vertices
    parts, label = sp.csgraph.connected_components(mesh.adjacency, directed=False)
    smallest = int(np.minimum(np.bincount(label, minlength=parts), 4).sum())
    if not smallest <= count <= n:
        raise OptionError(f"this mesh takes {smallest} to {n} tokens, not {count}")
    lengths = _edge_lengths(mesh, np.ones(n))
    if motion is None:
        tokens = _farthest_points(lengths, label, count)
    else:
        size = np.sqrt(np.square(motion).sum(-1).mean(0))
        stretch = 0.1 + np.sqrt(size / max(size.max(), 1e-12))
        tokens = _farthest_points(_edge_lengths(mesh, stretch), label, max(smallest, count // 2))
        for left in range(ROUNDS, 0, -1):
            spread = _prolongation(mesh, lengths, tokens, dijkstra(lengths, indices=tokens, min_only=True))
            missed = np.square(np.stack([spread @ m[tokens] - m for m in motion])).sum((0, 2))
            missed[tokens] = -1
            worst = np.argsort(-missed, kind="stable")[: (count - len(tokens)) // left]
            tokens = np.sort(np.concatenate([tokens, worst]))
    distance, _, nearest = dijkstra(
        lengths, indices=tokens, min_only=True, return_predecessors=True, directed=False
    )
    rank = np.full(n, -1)
    rank[tokens] = np.arange(count)
    cell = rank[nearest]
    edges = cell[mesh.edges]
    edges = np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1), axis=0)
    return TokenMesh(tokens, edges, _prolongation(mesh, lengths, tokens, distance))


def _edge_lengths(mesh: TriangleMesh, importance: np.ndarray) -> sp.csr_array:
    first, second = mesh.edges.T
    length = np.linalg.norm(mesh.vertices[first] - mesh.vertices[second], axis=1)
    length = np.maximum(length * (importance[first] + importance[second]) / 2, 1e-9)
    graph = sp.csr_array((length, (first, second)), shape=(mesh.n_vertices,) * 2)
    return (graph + graph.T).tocsr()


def _farthest_points(graph: sp.csr_array, label: np.ndarray, count: int) -> Int[np.ndarray, " count"]:
    distance = np.full(len(label), np.inf)
    chosen: list[int] = []

    def add(vertex: int) -> None:
        # What is farther than the largest distance so far cannot come closer.
        finite = distance[np.isfinite(distance) & (label == label[vertex])]
        limit = np.inf if distance[vertex] == np.inf else float(finite.max(initial=0.0))
        np.minimum(distance, dijkstra(graph, indices=vertex, limit=limit), out=distance)
        chosen.append(vertex)

    for part in range(label.max() + 1):
        members = np.flatnonzero(label == part)
        add(int(members[0]))
        for _ in range(min(len(members), 4) - 1):
            add(int(members[distance[members].argmax()]))
    while len(chosen) < count:
        add(int(distance.argmax()))
    return np.sort(np.array(chosen))


def _prolongation(
    mesh: TriangleMesh, lengths: sp.csr_array, tokens: np.ndarray, distance: np.ndarray
) -> sp.csr_array:
    """Moving least squares of degree one over the tokens nearest along the surface.

    The weights of a vertex are the smallest (each token's counted against its distance) that reproduce
    affine functions: rigid parts stay rigid.
    """
    n, count = mesh.n_vertices, len(tokens)
    free = np.flatnonzero(distance > 0)
    rows, columns, values = [tokens], [np.arange(count)], [np.ones(count)]
    if len(free):
        reach = 6 * distance[free].max()
        for block in np.array_split(free, max(1, len(free) // 512)):
            apart = dijkstra(lengths, indices=block, limit=reach, directed=False)[:, tokens]
            near = np.argsort(apart, axis=1, kind="stable")[:, : min(NEIGHBOURS, count)]
            gap = np.take_along_axis(apart, near, axis=1)
            closeness = np.where(np.isfinite(gap), np.exp(-((gap / (1.5 * gap[:, :1])) ** 2)), 0.0)
            offset = mesh.vertices[tokens[near]] - mesh.vertices[block, None]
            scale = np.linalg.norm(offset, axis=2).max(1)[:, None, None]
            basis = np.concatenate([np.ones((*near.shape, 1)), offset / scale], axis=2)
            normal = np.einsum("vki,vk,vkj->vij", basis, closeness, basis)
            # A faint pull towards the plain weighted mean, where the tokens lie in a plane or on a line.
            normal += 1e-4 * normal[:, :1, :1] * np.diag([0.0, 1.0, 1.0, 1.0])
            solved = np.linalg.solve(normal, np.broadcast_to(np.eye(4)[:, :1], (len(block), 4, 1)))[..., 0]
            weights = closeness * np.einsum("vki,vi->vk", basis, solved)
            rows.append(np.repeat(block, near.shape[1]))
            columns.append(near.ravel())
            values.append((weights / weights.sum(1, keepdims=True)).ravel())
    operator = sp.csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(n, count)
    )
    operator.eliminate_zeros()
    return operator
