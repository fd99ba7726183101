"""Geodesic distance by the heat method."""

from collections.abc import Sequence

import igl
import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import MeshError, OptionError
from meshanim.geometry.laplacian import zero_area_faces
from meshanim.geometry.topology import edge_uses, vertex_components

__all__ = ["HeatGeodesics"]


class HeatGeodesics:
    """Distances along a surface, factorised once, solved for many sources.

    The heat method of Crane, Weischedel and Wardetzky (2013), good to a few hundredths of the distance. Each
    connected component has its own factorisation, made when it is first asked for. The step of time is the
    squared mean edge length; edge-manifold components use their intrinsic Delaunay triangulation.

    Parameters
    ----------
    vertices : (V, 3) float
        Metres.
    faces : (F, 3) int
        Vertex indices.

    Raises
    ------
    MeshError
        If a face has no area.
    """

    def __init__(self, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]):
        flat = zero_area_faces(vertices, faces)
        if len(flat):
            raise MeshError(
                f"{len(flat)} triangles have no area, the first is face {flat[0]}; remove them with "
                "meshanim.geometry.repair"
            )
        self.vertices, self.faces = vertices, faces
        self.components = vertex_components(faces, len(vertices))
        self._solvers: dict[int, igl.HeatGeodesicsData] = {}

    def distance(
        self, sources: int | np.integer | Sequence[int] | np.ndarray
    ) -> Float[np.ndarray, " vertices"]:
        """Distance in metres from the nearest of the source vertices; infinite where none can be reached."""
        wanted = np.unique(np.atleast_1d(np.array(sources, np.int64)))
        if not len(wanted) or wanted[0] < 0 or wanted[-1] >= len(self.vertices):
            raise OptionError(
                f"sources must be vertex indices in 0..{len(self.vertices) - 1}, at least one, not "
                f"{np.asarray(sources).tolist()}"
            )
        result = np.full(len(self.vertices), np.inf)
        for label in np.unique(self.components[wanted]).tolist():
            members = np.flatnonzero(self.components == label)
            local = np.searchsorted(members, wanted[self.components[wanted] == label])
            if len(members) > len(local) > 0:
                found = igl.heat_geodesics_solve(self._solver(label, members), local)
                result[members] = np.maximum(found - found[local].min(), 0.0)
        result[wanted] = 0.0
        return result

    def _solver(self, label: int, members: np.ndarray) -> igl.HeatGeodesicsData:
        if label not in self._solvers:
            within = self.components[self.faces[:, 0]] == label
            faces = np.searchsorted(members, self.faces[within])
            vertices = np.ascontiguousarray(self.vertices[members])
            edges, edge_of_side = edge_uses(faces)
            data = igl.HeatGeodesicsData()
            data.use_intrinsic_delaunay = bool(np.bincount(edge_of_side.ravel()).max() <= 2)
            length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean()
            igl.heat_geodesics_precompute(vertices, faces, float(length**2), data)
            self._solvers[label] = data
        return self._solvers[label]
