"""Fewer triangles, and the matrices that carry values down to them and back up."""

from dataclasses import dataclass

import fast_simplification
import igl
import numpy as np
import scipy.sparse as sp

from meshanim.errors import MeshError, OptionError
from meshanim.geometry.closest_points import barycentric_coordinates
from meshanim.geometry.decimation_uv import decimated_texture
from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.topology import edge_uses
from meshanim.geometry.transfer import barycentric_operator

__all__ = ["Decimation", "Prolongation", "decimate", "prolongation"]

FEWEST_FACES = 8
"""What a connected component keeps at least, if it has as many: an octahedron still has a shape."""


@dataclass(frozen=True)
class Decimation:
    """A mesh of fewer triangles, its vertices on the surface of the mesh it came from."""

    mesh: TriangleMesh
    operator: sp.csr_array
    """(v, V): interpolates values of the old vertices at the new ones; the new positions are
    `operator @ vertices`, and so is each frame of an animation or blendshape. Rows sum to one."""
    cluster: np.ndarray
    """(V,) int: the new vertex into which each old one was merged, -1 for vertices without faces."""


@dataclass(frozen=True)
class Prolongation:
    """A coarse mesh of tokens, and how values on it spread over the full mesh."""

    mesh: TriangleMesh
    """The token mesh."""
    operator: sp.csr_array
    """(V, tokens): values of the tokens to values of the vertices. Rows sum to one."""
    restriction: sp.csr_array
    """(tokens, V): values of the vertices at the tokens. Rows sum to one."""


def decimate(mesh: TriangleMesh, n_faces: int) -> Decimation:
    """Reduce a mesh to about `n_faces` triangles by quadric edge collapse (fast-simplification).

    Connected components are reduced by the same share, each to 8 triangles at least, and a new vertex takes
    its values from that part of the surface which was merged into it: eyelids do not borrow from the eyes
    behind them, nor one lip from the other. Texture coordinates follow, those of a layout with seams by
    `decimated_texture`.

    Parameters
    ----------
    mesh : TriangleMesh
        Without triangles of no area.
    n_faces : int
        Wanted number of triangles, from 1 to that of the mesh. Edge collapses on a boundary take one
        triangle and others two, so the result may have one more a component.

    Raises
    ------
    OptionError
        If `n_faces` is out of range.
    MeshError
        If a triangle has no area.
    """
    if not 1 <= n_faces <= mesh.n_faces:
        raise OptionError(f"n_faces must be 1 to the mesh's {mesh.n_faces}, not {n_faces}")
    positions, faces, cluster = _collapse(mesh, n_faces)
    corners, weights = _closest_in(mesh, _touching(cluster, mesh.faces, len(positions)), positions)
    operator = barycentric_operator(corners, weights, mesh.n_vertices)
    positions = operator @ mesh.vertices
    uv = uv_faces = None
    if mesh.uv is not None and mesh.uv_faces is mesh.faces:
        uv = operator @ mesh.uv
    elif mesh.uv is not None:
        uv, uv_faces = decimated_texture(mesh, cluster, positions, faces)
    return Decimation(TriangleMesh(positions, faces, uv, uv_faces), operator, cluster)


def prolongation(mesh: TriangleMesh, count: int, method: str = "barycentric") -> Prolongation:
    """Make a token mesh of about `count` vertices and the sparse matrix from its vertices to all of them.

    Parameters
    ----------
    mesh : TriangleMesh
        Every vertex in a face, no triangle without area.
    count : int
        Wanted number of tokens, from 4 to the number of vertices; components keep some tokens each, so a
        mesh of many components cannot have very few.
    method : "barycentric" or "biharmonic"
        Barycentric: at most three tokens a vertex, those of the closest point on the token mesh near where
        the vertex was merged to. Biharmonic: smooth weights (Jacobson et al. 2011 without bounds), one at a
        token's own vertex, the largest 16 of each row kept; some are negative.

    Returns
    -------
    Prolongation
        `mesh`, `operator` (V, tokens), `restriction` (tokens, V).

    Raises
    ------
    OptionError
        If `count` is out of range.
    MeshError
        If a vertex has no face, or a triangle no area.
    """
    if not 4 <= count <= mesh.n_vertices:
        raise OptionError(f"count must be 4 to the mesh's {mesh.n_vertices} vertices, not {count}")
    if method not in ("barycentric", "biharmonic"):
        raise OptionError(f"method must be 'barycentric' or 'biharmonic', not {method!r}")
    if len(mesh.unused_vertices):
        raise MeshError(
            f"{len(mesh.unused_vertices)} vertices belong to no face, the first is "
            f"{mesh.unused_vertices[0]}; remove them with meshanim.geometry.repair"
        )
    coarse = decimate(mesh, _faces_for(mesh, count))
    if method == "barycentric":
        around = _touching(np.arange(coarse.mesh.n_vertices), coarse.mesh.faces, coarse.mesh.n_vertices)
        corners, weights = _closest_in(coarse.mesh, around[coarse.cluster], mesh.vertices)
        operator = barycentric_operator(corners, weights, coarse.mesh.n_vertices)
    else:
        operator = _biharmonic(mesh, coarse)
    return Prolongation(coarse.mesh, operator, coarse.operator)


def _collapse(mesh: TriangleMesh, n_faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and faces of the simplified mesh, and the new vertex of each old one."""
    if len(mesh.degenerate_faces):
        raise MeshError(
            f"{len(mesh.degenerate_faces)} triangles have no area, the first is face "
            f"{mesh.degenerate_faces[0]}; remove them with meshanim.geometry.repair"
        )
    share = n_faces / mesh.n_faces
    component = mesh.components[mesh.faces[:, 0]]
    cluster = np.full(mesh.n_vertices, -1)
    positions, faces, count = [], [], 0
    for label in np.unique(component):
        members, local = np.unique(mesh.faces[component == label], return_inverse=True)
        local = local.reshape(-1, 3)
        target = max(round(len(local) * share), min(len(local), FEWEST_FACES))
        points, triangles, merged = _simplified(mesh.vertices[members], local, target)
        cluster[members] = merged + count
        positions.append(points)
        faces.append(triangles + count)
        count += len(points)
    return np.concatenate(positions), np.concatenate(faces), cluster


def _simplified(
    vertices: np.ndarray, faces: np.ndarray, target: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if target >= len(faces):
        return vertices, faces, np.arange(len(vertices))
    narrow = faces.astype(np.int32)
    points, triangles, collapses = fast_simplification.simplify(
        vertices, narrow, target_count=target, return_collapses=True
    )
    _, _, merged = fast_simplification.replay_simplification(vertices, narrow, collapses)
    # In flat regions neighbours can be moved to one place; odd edges can leave triangles doubled.
    points, triangles, welded = _without_zero_edges(points, triangles.astype(np.int64))
    merged = welded[merged]
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    triangles = triangles[np.sort(first)]
    if not len(triangles) or len(np.unique(triangles)) < len(points) or len(np.unique(merged)) < len(points):
        return vertices, faces, np.arange(len(vertices))
    return points, triangles, merged


def _without_zero_edges(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contract edges of next to no length; also returns the new vertex of each old one."""
    edges, _ = edge_uses(faces)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    zero = edges[length < 1e-6 * np.ptp(points, axis=0).max()]
    graph = sp.csr_array((np.ones(len(zero)), zero.T), shape=(len(points), len(points)))
    _, label = sp.csgraph.connected_components(graph, directed=False)
    _, first, label = np.unique(label, return_index=True, return_inverse=True)
    faces = label.ravel()[faces]
    return points[first], faces[(faces != np.roll(faces, 1, axis=1)).all(1)], label.ravel()


def _touching(cluster: np.ndarray, faces: np.ndarray, n_clusters: int) -> sp.csr_array:
    """(clusters, F) pattern: the faces with a corner in each cluster."""
    owner, face = cluster[faces].ravel(), np.repeat(np.arange(len(faces)), 3)
    pattern = sp.csr_array((np.ones(len(owner)), (owner, face)), shape=(n_clusters, len(faces)))
    pattern.sum_duplicates()
    return pattern


def _closest_in(
    mesh: TriangleMesh, candidates: sp.csr_array, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 3) and weights (n, 3) of the point of each row's candidate faces closest to each point."""
    row = np.repeat(np.arange(len(points)), np.diff(candidates.indptr))
    face = candidates.indices
    corners = mesh.vertices[mesh.faces[face]]
    weights = barycentric_coordinates(points[row], corners)
    distance = ((np.einsum("nk,nkd->nd", weights, corners) - points[row]) ** 2).sum(1)
    order = np.lexsort((distance, row))
    best = order[np.searchsorted(row[order], np.arange(len(points)))]
    return mesh.faces[face[best]], weights[best]


def _faces_for(mesh: TriangleMesh, count: int) -> int:
    """The number of triangles that leaves closest to `count` vertices."""
    wanted = mesh.n_faces * count / mesh.n_vertices
    best, smallest = mesh.n_faces, float("inf")
    for _ in range(5):
        n_faces = int(np.clip(round(wanted), 1, mesh.n_faces))
        found = len(_collapse(mesh, n_faces)[0])
        if abs(found - count) < smallest:
            best, smallest = n_faces, abs(found - count)
        if found == count:
            break
        wanted = (
            n_faces * count / found if abs(found - count) > 0.02 * count else n_faces + 2 * (count - found)
        )
    return best


def _biharmonic(mesh: TriangleMesh, coarse: Decimation, kept: int = 16) -> sp.csr_array:
    n, tokens = mesh.n_vertices, coarse.mesh.n_vertices
    handles = _nearest_members(mesh, coarse)
    weights = igl.harmonic(mesh.vertices, mesh.faces, handles, np.eye(tokens), 2)
    if not np.isfinite(weights).all():
        raise MeshError("the biharmonic system is singular on this mesh; use method='barycentric'")
    keep = np.argsort(-np.abs(weights), axis=1)[:, :kept]
    rows = np.repeat(np.arange(n), keep.shape[1])
    values = np.take_along_axis(weights, keep, axis=1)
    values /= values.sum(1, keepdims=True)
    operator = sp.csr_array((values.ravel(), (rows, keep.ravel())), shape=(n, tokens))
    operator.eliminate_zeros()
    operator.sort_indices()
    return operator


def _nearest_members(mesh: TriangleMesh, coarse: Decimation) -> np.ndarray:
    """The vertex nearest to each token among those merged into it."""
    distance = ((mesh.vertices - coarse.mesh.vertices[coarse.cluster]) ** 2).sum(1)
    order = np.lexsort((distance, coarse.cluster))
    return order[np.searchsorted(coarse.cluster[order], np.arange(coarse.mesh.n_vertices))]
