"""Mending meshes by pymeshlab, so that the operators of the other modules take them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from meshanim.errors import MeshError, OptionError
from meshanim.geometry.laplacian import zero_area_faces
from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.topology import edge_uses

__all__ = ["Repair", "repair"]


@dataclass(frozen=True)
class Repair:
    """A mended mesh and where its vertices come from."""

    mesh: TriangleMesh
    vertex: np.ndarray
    """(v,) int: the given vertex that each one was; several where a vertex was split."""
    operator: sp.csr_array
    """(v, V): a single one in each row, to carry values, frames or blendshapes over."""
    changes: dict[str, int]
    """How many vertices or faces were removed, added or turned, by what was wrong; only what was."""


def repair(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    merge_distance: float | None = None,
    fill_holes: int = 0,
    non_manifold: str = "split",
    orient: bool = True,
) -> Repair:
    """Remove what no operator can use and mend what can be mended.

    In this order: faces that repeat a vertex or have one that is not finite; vertices closer than
    `merge_distance`; duplicate faces; non-manifold edges and vertices; triangles without area (their longest
    side is flipped where that helps, else they go); orientation; holes; vertices in no face.
    Positions never change. Texture coordinates are not taken; carry them with `operator` if there is one
    for each vertex.

    Parameters
    ----------
    vertices : (V, 3) float
        Metres.
    faces : (F, 3) int
        Vertex indices.
    merge_distance : float, optional
        Metres; 0 merges equal positions only. By default nothing is merged: seams stay seams.
    fill_holes : int
        Fill holes of at most this many edges, without new vertices; 0 fills none.
    non_manifold : "split" or "remove"
        At edges of three and more faces: give each sheet its own copy of the vertices, or remove the
        smallest faces until two are left. Vertices where fans of faces touch are split either way.
    orient : bool
        Whether to turn faces so that neighbours agree, where that is possible.

    Raises
    ------
    OptionError
        If an option is out of range.
    MeshError
        If a face names a vertex that does not exist, or nothing is left.
    """
    if non_manifold not in ("split", "remove"):
        raise OptionError(f"non_manifold must be 'split' or 'remove', not {non_manifold!r}")
    if fill_holes < 0 or (merge_distance is not None and merge_distance < 0):
        raise OptionError(
            f"merge_distance and fill_holes must not be negative, got {merge_distance} and {fill_holes}"
        )
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise MeshError(f"faces name vertices {faces.min()}..{faces.max()}, but there are {len(vertices)}")

    finite = np.isfinite(vertices).all(1)
    sound = finite[faces].all(1) & (faces != np.roll(faces, 1, axis=1)).all(1)
    if not sound.any():
        raise MeshError(f"no usable triangle among {len(faces)}")
    changes = {"unusable faces": int((~sound).sum())}
    work = _Workpiece(np.where(finite[:, None], vertices, 0.0), faces[sound])
    if merge_distance is not None:
        # A zero threshold would merge nothing; this is below any two distinct positions of a head.
        changes["merged vertices"] = work.merge_within(max(merge_distance, 1e-12))
    changes["duplicate faces"] = work.step("meshing_remove_duplicate_faces")[1]
    if non_manifold == "remove":
        gone = work.step("meshing_repair_non_manifold_edges", {"method": "Remove Faces"})[1]
        changes["faces at non-manifold edges"] = gone
    if not len(work.faces()):
        raise MeshError(f"no usable triangle is left of {len(faces)}; is merge_distance too large?")
    work.split_fans()
    if len(work.flat_faces()):
        work.step("meshing_remove_t_vertices", {"method": "Edge Flip", "threshold": 1e6, "repeat": True})
        changes["triangles without area"] = work.remove_flat_faces()
    if orient:
        before = work.faces()
        work.step("meshing_re_orient_faces_coherently")
        changes["turned faces"] = _turned(before, work.faces())
    if fill_holes:
        filled = work.step("meshing_close_holes", {"maxholesize": fill_holes, "newfaceselected": False})[1]
        changes["faces in holes"] = -filled - work.remove_flat_faces()
    work.step("meshing_remove_unreferenced_vertices")
    vertex = work.origin()
    used = len(np.unique(vertex))
    changes["split vertices"] = len(vertex) - used
    changes["unused vertices"] = len(vertices) - used - changes.get("merged vertices", 0)
    operator = sp.csr_array(
        (np.ones(len(vertex)), (np.arange(len(vertex)), vertex)), shape=(len(vertex), len(vertices))
    )
    mesh = TriangleMesh(vertices[vertex], work.faces())
    return Repair(mesh, vertex, operator, {name: count for name, count in changes.items() if count})


class _Workpiece:
    """A mesh in pymeshlab that remembers the index of each vertex as its quality."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self._load(vertices, faces, np.arange(len(vertices)))

    def _load(self, vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray) -> None:
        import pymeshlab  # slow to load, and few need it

        self.set = pymeshlab.MeshSet(verbose=False)
        self.set.add_mesh(
            pymeshlab.Mesh(
                vertex_matrix=np.ascontiguousarray(vertices, np.float64),
                face_matrix=np.ascontiguousarray(faces, np.int32),
                v_scalar_array=origin.astype(np.float64),
            )
        )

    def step(self, name: str, options: dict[str, Any] | None = None) -> tuple[int, int]:
        """Apply a filter; how many vertices and faces went."""
        vertices, faces = self._count()
        self.set.apply_filter(name, **(options or {}))
        after_vertices, after_faces = self._count()
        return vertices - after_vertices, faces - after_faces

    def merge_within(self, distance: float) -> int:
        """Merge vertices that lie no farther apart; how many went."""
        import pymeshlab

        return self.step("meshing_merge_close_vertices", {"threshold": pymeshlab.PureValue(distance)})[0]

    def split_fans(self) -> None:
        """Give each fan of faces its own vertices."""
        faces, source = _split_fans(self.faces(), self._count()[0])
        if len(source) > self._count()[0]:
            self._load(self.set.current_mesh().vertex_matrix()[source], faces, self.origin()[source])

    def flat_faces(self) -> np.ndarray:
        return zero_area_faces(self.set.current_mesh().vertex_matrix(), self.faces())

    def remove_flat_faces(self) -> int:
        """Remove triangles without area and split the fans that this leaves; how many went."""
        flat, faces = self.flat_faces(), self.faces()
        if len(flat) == len(faces):
            raise MeshError("no triangle has an area")
        if len(flat):
            self._load(self.set.current_mesh().vertex_matrix(), np.delete(faces, flat, axis=0), self.origin())
            self.split_fans()
        return len(flat)

    def faces(self) -> np.ndarray:
        return np.asarray(self.set.current_mesh().face_matrix(), np.int64).reshape(-1, 3)

    def origin(self) -> np.ndarray:
        return np.rint(self.set.current_mesh().vertex_scalar_array()).astype(np.int64)

    def _count(self) -> tuple[int, int]:
        mesh = self.set.current_mesh()
        return mesh.vertex_number(), mesh.face_number()


def _turned(before: np.ndarray, after: np.ndarray) -> int:
    """Faces whose corners run the other way round."""
    start = after.argmin(1)[:, None]
    rolled = np.take_along_axis(after, (start + np.arange(3)) % 3, axis=1)
    start = before.argmin(1)[:, None]
    expected = np.take_along_axis(before, (start + np.arange(3)) % 3, axis=1)
    return int((rolled != expected).any(1).sum())


def _split_fans(faces: np.ndarray, n_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces after giving each fan at a vertex its own copy of it, and the old vertex of each new one.

    Two corners at a vertex belong to one fan if an edge of exactly two faces joins them. pymeshlab's filters
    for this leave some meshes non-manifold.
    """
    source = np.arange(n_vertices)
    while True:
        edges, edge_of_side = edge_uses(faces)
        side_edge = edge_of_side.ravel()
        uses = np.bincount(side_edge, minlength=len(edges))
        order = np.argsort(side_edge, kind="stable")
        first, second = order[uses[side_edge[order]] == 2].reshape(-1, 2).T
        corner = np.arange(3 * len(faces)).reshape(-1, 3)
        start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
        along = faces.ravel()[start[first]] == faces.ravel()[start[second]]
        links = [
            (start[first], np.where(along, start[second], end[second])),
            (end[first], np.where(along, end[second], start[second])),
        ]
        rows, columns = np.concatenate(links, axis=1)
        graph = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=(3 * len(faces),) * 2)
        _, fan = sp.csgraph.connected_components(graph, directed=False)
        _, leader, fan = np.unique(fan, return_index=True, return_inverse=True)
        vertex = faces.ravel()[leader]
        # The first fan at each vertex keeps it.
        extra = np.ones(len(leader), bool)
        extra[np.unique(vertex, return_index=True)[1]] = False
        name = np.where(extra, len(source) + np.cumsum(extra) - 1, vertex)
        source = np.concatenate([source, source[vertex[extra]]])
        faces = name[fan.ravel()].reshape(-1, 3)

        # An edge of more than two faces whose fans join elsewhere: its later faces come off altogether.
        edges, edge_of_side = edge_uses(faces)
        side_edge = edge_of_side.ravel()
        order = np.argsort(side_edge, kind="stable")
        begins = np.searchsorted(side_edge[order], side_edge[order])
        loose = np.unique(order[np.arange(len(order)) - begins >= 2] // 3)
        if not len(loose):
            return faces, source
        count = 3 * len(loose)
        torn = faces[loose].ravel()
        faces = faces.copy()
        faces[loose] = len(source) + np.arange(count).reshape(-1, 3)
        source = np.concatenate([source, source[torn]])
