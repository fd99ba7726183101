"""`TriangleMesh`: topology and rest geometry, with operators computed once and kept."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int

from meshanim.errors import MeshError, ShapeError
from meshanim.geometry import laplacian, normals, topology
from meshanim.geometry.geodesics import HeatGeodesics

__all__ = ["TriangleMesh"]


class TriangleMesh:
    """A triangle mesh in metres, y up; float64 vertices, int64 faces, counter-clockwise seen from outside.

    Parameters
    ----------
    vertices : (V, 3) float
        Positions in metres.
    faces : (F, 3) int
        Vertex indices.
    uv : (U, 2) float, optional
        Texture coordinates, origin at the lower left.
    uv_faces : (F, 3) int, optional
        Indices into `uv`; `faces` itself when `uv` has a row a vertex.

    Raises
    ------
    ShapeError
        If an array has the wrong shape, a vertex is NaN or infinite, or `uv_faces` is missing.
    MeshError
        If a face names a vertex that does not exist or repeats one.
    """

    def __init__(self, vertices, faces, uv=None, uv_faces=None):
        self.vertices: Float[np.ndarray, "vertices 3"] = _rows(vertices, 3, np.float64, "vertices")
        self.faces: Int[np.ndarray, "faces 3"] = _rows(faces, 3, np.int64, "faces")
        if not np.isfinite(self.vertices).all():
            bad = np.flatnonzero(~np.isfinite(self.vertices).all(1))
            raise ShapeError(f"vertices: {len(bad)} rows are NaN or infinite, the first is row {bad[0]}")
        _check_indices(self.faces, len(self.vertices), "faces", "vertices")
        repeated = (self.faces == np.roll(self.faces, 1, axis=1)).any(1)
        if repeated.any():
            raise MeshError(
                f"faces: {repeated.sum()} triangles name a vertex twice, the first is face "
                f"{np.flatnonzero(repeated)[0]}; remove them with meshanim.geometry.repair"
            )
        self.uv = None if uv is None else _rows(uv, 2, np.float64, "uv")
        self.uv_faces = None
        if self.uv is not None:
            if uv_faces is None and len(self.uv) != len(self.vertices):
                raise ShapeError(f"uv has {len(self.uv)} rows, vertices {len(self.vertices)}: give uv_faces")
            self.uv_faces = self.faces if uv_faces is None else _rows(uv_faces, 3, np.int64, "uv_faces")
            if len(self.uv_faces) != len(self.faces):
                raise ShapeError(f"uv_faces has {len(self.uv_faces)} rows, faces {len(self.faces)}")
            _check_indices(self.uv_faces, len(self.uv), "uv_faces", "uv")

        self._eigenbasis: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def n_vertices(self) -> int:
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        return len(self.faces)

    @cached_property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """Undirected edges, each once, smaller index first, sorted."""
        return topology.edge_uses(self.faces)[0]

    @cached_property
    def adjacency(self) -> sp.csr_array:
        """Symmetric (V, V) matrix of ones where two vertices share an edge; sorted CSR, empty diagonal."""
        edges, n = self.edges, self.n_vertices
        rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
        matrix = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
        matrix.sort_indices()
        return matrix

    @cached_property
    def laplacian(self) -> sp.csr_array:
        """Cotangent Laplacian (V, V), positive semi-definite; see `cotangent_laplacian`."""
        return laplacian.cotangent_laplacian(self.vertices, self.faces)

    @cached_property
    def mass(self) -> sp.csr_array:
        """Diagonal (V, V) matrix of vertex areas in m²; see `vertex_masses`."""
        return laplacian.vertex_masses(self.vertices, self.faces)

    def eigenbasis(self, k: int) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "vertices k"]]:
        """The k lowest Laplace-Beltrami eigenvalues (1/m²) and mass-orthonormal eigenvectors, kept."""
        if self._eigenbasis is None or not 1 <= k <= len(self._eigenbasis[0]):
            self._eigenbasis = laplacian.eigenbasis(self.laplacian, self.mass, k)
        values, vectors = self._eigenbasis
        return values[:k], vectors[:, :k]

    @cached_property
    def geodesics(self) -> HeatGeodesics:
        """The heat-method solver, factorised once."""
        return HeatGeodesics(self.vertices, self.faces)

    def geodesic(
        self, sources: int | np.integer | Sequence[int] | np.ndarray
    ) -> Float[np.ndarray, " vertices"]:
        """Distance in metres along the surface from the nearest source; infinite on other components."""
        return self.geodesics.distance(sources)

    @cached_property
    def face_areas(self) -> Float[np.ndarray, " faces"]:
        """Area of each face in m²."""
        return np.linalg.norm(self._area_vectors, axis=1)

    @cached_property
    def face_normals(self) -> Float[np.ndarray, "faces 3"]:
        """Unit normals; zero for a face without area."""
        return normals.face_normals(*self._tensors).numpy()

    @cached_property
    def vertex_normals(self) -> Float[np.ndarray, "vertices 3"]:
        """Unit normals, faces weighted by area; zero where they cancel or there are none."""
        return normals.vertex_normals(*self._tensors).numpy()

    @property
    def area(self) -> float:
        """Area of the surface in m²."""
        return float(self.face_areas.sum())

    @property
    def volume(self) -> float:
        """Volume in m³ enclosed by a closed mesh, positive if its normals point outwards.

        Raises
        ------
        MeshError
            If the mesh has a boundary.
        """
        if not self.is_closed:
            raise MeshError(f"volume needs a closed mesh; this one has {len(self.boundary)} boundary edges")
        return float((self._area_vectors * self.vertices[self.faces].mean(1)).sum() / 3)

    @cached_property
    def angle_defects(self) -> Float[np.ndarray, " vertices"]:
        """Integrated Gaussian curvature in radians: 2 π (π on the boundary) less the angles at each vertex.

        Summed over a mesh without unused vertices this is 2 π times the Euler characteristic.
        """
        corners = self.vertices[self.faces]
        ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
        angles = np.arctan2(np.linalg.norm(np.cross(ahead, behind), axis=2), (ahead * behind).sum(2))
        full = np.full(self.n_vertices, 2 * np.pi)
        full[np.unique(self.boundary)] = np.pi
        full[self.unused_vertices] = 0.0
        return full - np.bincount(self.faces.ravel(), angles.ravel(), minlength=self.n_vertices)

    @cached_property
    def boundary(self) -> Int[np.ndarray, "boundary 2"]:
        """Edges of one face only, directed as in that face."""
        return topology.boundary_edges(self.faces)

    @property
    def boundary_loops(self) -> list[np.ndarray]:
        """Closed loops of boundary vertices, the longest first; see `topology.boundary_loops`."""
        return topology.boundary_loops(self.faces)

    @cached_property
    def components(self) -> Int[np.ndarray, " vertices"]:
        """Label of the connected component of each vertex, from 0 in order of first vertex."""
        return topology.vertex_components(self.faces, self.n_vertices)

    @property
    def n_components(self) -> int:
        return int(self.components.max(initial=-1)) + 1

    @cached_property
    def unused_vertices(self) -> Int[np.ndarray, " unused"]:
        """Vertices that no face names."""
        return np.setdiff1d(np.arange(self.n_vertices), self.faces)

    @cached_property
    def degenerate_faces(self) -> Int[np.ndarray, " degenerate"]:
        """Faces without area."""
        return laplacian.zero_area_faces(self.vertices, self.faces)

    @property
    def euler_characteristic(self) -> int:
        """V - E + F, counting used vertices only; 2 for a sphere, 1 for a disc."""
        return self.n_vertices - len(self.unused_vertices) - len(self.edges) + self.n_faces

    @cached_property
    def manifold_vertices(self) -> Bool[np.ndarray, " vertices"]:
        """Whether the faces around each vertex form one fan or ring."""
        return topology.is_manifold(self.faces, self.n_vertices)

    @property
    def is_manifold(self) -> bool:
        """Whether every edge has at most two faces, every vertex one fan of them; boundaries are allowed."""
        return bool(self.manifold_vertices.all())

    @property
    def is_closed(self) -> bool:
        """Whether no edge has one face only."""
        return len(self.boundary) == 0

    @cached_property
    def is_oriented(self) -> bool:
        """Whether neighbouring faces agree on which side is outside."""
        return topology.is_consistently_oriented(self.faces)

    @property
    def _tensors(self) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.from_numpy(self.vertices), torch.from_numpy(self.faces)

    @cached_property
    def _area_vectors(self) -> np.ndarray:
        return normals.area_vectors(*self._tensors).numpy()

    def with_vertices(self, vertices) -> "TriangleMesh":
        """The same topology and texture coordinates at other positions."""
        return TriangleMesh(vertices, self.faces, self.uv, self.uv_faces)

    def __repr__(self) -> str:
        texture = "" if self.uv is None else f", {len(self.uv)} texture coordinates"
        return f"TriangleMesh({self.n_vertices} vertices, {self.n_faces} faces{texture})"


def _rows(array, columns: int, dtype, name: str) -> np.ndarray:
    array = np.asarray(array)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ShapeError(f"{name} must have shape (n, {columns}), not {array.shape}")
    if dtype is np.int64 and not np.issubdtype(array.dtype, np.integer):
        raise ShapeError(f"{name} must be integers, not {array.dtype}")
    return np.ascontiguousarray(array, dtype)


def _check_indices(faces: np.ndarray, size: int, name: str, target: str) -> None:
    if faces.size and (faces.min() < 0 or faces.max() >= size):
        raise MeshError(f"{name} name {target} {faces.min()}..{faces.max()}, but there are {size}")
