"""Subdivision of triangle meshes, as sparse matrices that carry positions and all other values along."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Int

from meshanim.errors import OptionError, ShapeError
from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.stencils import averages, incidence, rows_where, scaled, tidy
from meshanim.geometry.topology import edge_uses

__all__ = ["Subdivision", "split_faces", "subdivide"]

METHODS = ("midpoint", "loop", "centroid", "barycentric")


@dataclass(frozen=True)
class Subdivision:
    """A finer mesh; new positions, blendshapes or frames are `operator @ old`."""

    mesh: TriangleMesh
    operator: sp.csr_array
    """(new vertices, V), rows sum to one; the old vertices come first."""
    parent: np.ndarray
    """(new faces,) int: the old face in which each new one lies; ascending."""


def subdivide(mesh: TriangleMesh, method: str = "midpoint", steps: int = 1) -> Subdivision:
    """Subdivide every triangle of a mesh, texture coordinates included.

    Parameters
    ----------
    mesh : TriangleMesh
        Any; edges of one face, or of three and more, are kept as curves by "loop".
    method : str
        "midpoint": four triangles by the midpoints of the sides, the shape stays. "loop": the same
        triangles on the smooth surface of Loop (1987), boundaries as cubic B-splines. "centroid": three
        triangles around the centroid. "barycentric": six, by the medians.
    steps : int
        How often, 0 or more.

    Raises
    ------
    OptionError
        If the method does not exist or `steps` is negative.
    """
    if method not in METHODS:
        raise OptionError(f"method must be one of {', '.join(METHODS)}, not {method!r}")
    if steps < 0:
        raise OptionError(f"steps must be 0 or more, not {steps}")
    operator = sp.diags_array(np.ones(mesh.n_vertices)).tocsr()
    parent = np.arange(mesh.n_faces)
    for _ in range(steps):
        weights, faces, child_of = _step(mesh.faces, mesh.n_vertices, method)
        operator, parent = (weights @ operator).tocsr(), parent[child_of]
        uv, uv_faces = None, None
        if mesh.uv is not None and mesh.uv_faces is not None:
            linear = "midpoint" if method == "loop" else method
            uv_weights, uv_faces, _ = _step(mesh.uv_faces, len(mesh.uv), linear)
            uv = uv_weights @ mesh.uv
        mesh = TriangleMesh(weights @ mesh.vertices, faces, uv, uv_faces)
    return Subdivision(mesh, tidy(operator), parent)


def split_faces(
    mesh: TriangleMesh,
    selected: Int[np.ndarray, " selected"] | Bool[np.ndarray, " faces"],
    conforming: bool = True,
) -> Subdivision:
    """Split selected triangles in four by the midpoints of their sides; the shape stays.

    Parameters
    ----------
    mesh : TriangleMesh
        Texture coordinates follow.
    selected : (n,) int or (F,) bool
        Faces to split.
    conforming : bool
        If true, no vertex is left in the middle of an unsplit side: a neighbour with one split side is cut
        in two, one with more is split in four as well, and so on (red-green refinement, Bank, Sherman and
        Weiser 1983). If false, the other triangles stay as they are.

    Raises
    ------
    OptionError
        If a face does not exist.
    ShapeError
        If a mask has not one entry a face.
    """
    red = _mask(selected, mesh.n_faces)
    edges, edge_of_side = edge_uses(mesh.faces)
    split = np.zeros(len(edges), bool)
    split[edge_of_side[red]] = True
    while conforming and (more := (split[edge_of_side].sum(1) > 1) & ~red).any():
        red = red | more
        split[edge_of_side[more]] = True
    cut = split[edge_of_side] if conforming else np.repeat(red[:, None], 3, axis=1)

    operator, faces, parent = _split_sides(mesh.faces, mesh.n_vertices, cut)
    uv, uv_faces = None, None
    if mesh.uv is not None and mesh.uv_faces is not None:
        uv_operator, uv_faces, _ = _split_sides(mesh.uv_faces, len(mesh.uv), cut)
        uv = uv_operator @ mesh.uv
    return Subdivision(TriangleMesh(operator @ mesh.vertices, faces, uv, uv_faces), operator, parent)


def _mask(selected: np.ndarray, n_faces: int) -> np.ndarray:
    if selected.dtype == bool:
        if len(selected) != n_faces:
            raise ShapeError(f"selected has {len(selected)} entries, the mesh {n_faces} faces")
        return selected
    if selected.size and (selected.min() < 0 or selected.max() >= n_faces):
        raise OptionError(f"selected names faces {selected.min()}..{selected.max()}, but there are {n_faces}")
    mask = np.zeros(n_faces, bool)
    mask[selected] = True
    return mask


def _step(faces: np.ndarray, n_vertices: int, method: str) -> tuple[sp.csr_array, np.ndarray, np.ndarray]:
    """Weights of the new vertices, new faces, and the old face of each."""
    if method in ("midpoint", "loop"):
        operator, new_faces, parent = _split_sides(faces, n_vertices, np.ones((len(faces), 3), bool))
        if method == "loop":
            operator = _loop_weights(faces, n_vertices)
        return operator, new_faces, parent
    identity = sp.diags_array(np.ones(n_vertices))
    after = np.roll(faces, -1, axis=1)
    if method == "centroid":
        centre = np.repeat(n_vertices + np.arange(len(faces))[:, None], 3, axis=1)
        operator = sp.vstack([identity, averages(faces, n_vertices)])
        children = np.stack([faces, after, centre], axis=2)
    else:
        edges, edge_of_side = edge_uses(faces)
        middle = n_vertices + edge_of_side
        centre = np.repeat(n_vertices + len(edges) + np.arange(len(faces))[:, None], 3, axis=1)
        operator = sp.vstack([identity, averages(edges, n_vertices), averages(faces, n_vertices)])
        children = np.concatenate(
            [np.stack([faces, middle, centre], axis=2), np.stack([middle, after, centre], axis=2)], axis=1
        )
    return (
        tidy(operator.tocsr()),
        children.reshape(-1, 3),
        np.repeat(np.arange(len(faces)), children.shape[1]),
    )


def _split_sides(
    faces: np.ndarray, n_vertices: int, cut: np.ndarray
) -> tuple[sp.csr_array, np.ndarray, np.ndarray]:
    """Split faces at the midpoints of the sides marked in `cut` (F, 3): none, one or all three of each."""
    edges, edge_of_side = edge_uses(faces)
    is_cut = np.zeros(len(edges), bool)
    is_cut[edge_of_side[cut]] = True
    operator = sp.vstack([sp.diags_array(np.ones(n_vertices)), averages(edges[is_cut], n_vertices)])
    middle = n_vertices + (np.cumsum(is_cut) - 1)[edge_of_side]

    number = cut.sum(1)
    whole, halved, quartered = (np.flatnonzero(number == n) for n in (0, 1, 3))
    # Halved faces, turned so that their first side is the cut one.
    turn = (cut[halved].argmax(1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces[halved], turn, axis=1).T
    ab = middle[halved, turn[:, 0]]
    halves = np.stack([np.stack([a, ab, c], 1), np.stack([ab, b, c], 1)], axis=1)
    p, q, r = faces[quartered].T
    pq, qr, rp = middle[quartered].T
    corners = [[p, pq, rp], [q, qr, pq], [r, rp, qr], [pq, qr, rp]]
    quarters = np.stack([np.stack(child, axis=1) for child in corners], axis=1)

    parent = np.concatenate([whole, np.repeat(halved, 2), np.repeat(quartered, 4)])
    children = np.concatenate([faces[whole], halves.reshape(-1, 3), quarters.reshape(-1, 3)])
    order = np.argsort(parent, kind="stable")
    return tidy(operator.tocsr()), children[order], parent[order]


def _loop_weights(faces: np.ndarray, n_vertices: int) -> sp.csr_array:
    """Loop's rules, rows as in `_split_sides`: old vertices, then edges."""
    edges, edge_of_side = edge_uses(faces)
    uses = np.bincount(edge_of_side.ravel(), minlength=len(edges))
    curve = uses != 2
    midpoints = averages(edges, n_vertices)
    # 3/8 of the ends and 1/8 of the opposite corners = 1/4 of the ends and 3/8 of each face's centroid.
    beside = incidence(edge_of_side, len(edges)) @ averages(faces, n_vertices)
    edge_points = rows_where(curve, midpoints, 0.25 * midpoints + 0.375 * beside)

    edges_of_vertex = incidence(edges, n_vertices)
    valence = edges_of_vertex.sum(1)
    n = np.maximum(valence, 1)
    beta = (0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / n)) ** 2) / n
    # The sum over neighbours is twice the sum of edge midpoints less the vertex itself, once an edge.
    smooth = scaled(2 * beta, edges_of_vertex @ midpoints) + sp.diags_array(1 - 2 * n * beta)
    n_curves = edges_of_vertex @ curve.astype(float)
    on_curve = n_curves == 2
    along = 0.25 * edges_of_vertex @ scaled(curve.astype(float), midpoints)
    spline = along + 0.5 * sp.diags_array(np.ones(n_vertices))
    fixed = (valence == 0) | ((n_curves > 0) & ~on_curve)
    identity = sp.diags_array(np.ones(n_vertices))
    vertex_points = rows_where(fixed, identity, rows_where(on_curve, spline, smooth))
    return tidy(sp.vstack([vertex_points, edge_points]).tocsr())
