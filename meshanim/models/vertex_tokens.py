"""`VertexTokens`: the vertices a network attends over, what it knows of them, and the way to the mesh."""

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from meshanim.attention import MeshGraph
from meshanim.errors import FileFormatError
from meshanim.geometry import TriangleMesh
from meshanim.models.gava_parts import SparseRows
from meshanim.models.token_mesh import choose_tokens

__all__ = ["VertexTokens", "vertex_descriptors"]

OCTAVES = 5
EXTENT = 0.1
"""Metres: positions and their waves are measured in this length, about the radius of a head."""


def vertex_descriptors(mesh: TriangleMesh, eigenfunctions: int) -> Float[np.ndarray, "vertices descriptors"]:
    """Fixed features of each vertex, all of about unit size.

    Laplace-Beltrami eigenfunctions say where on the surface a vertex is (upper and lower lip, which nearly
    touch, are far apart there), the position and waves of it where in space, the normal which way it faces.

    Parameters
    ----------
    mesh : TriangleMesh
        Reference geometry, metres.
    eigenfunctions : int
        How many; the constant one is left out. Columns beyond the number of vertices are zero.

    Returns
    -------
    (V, eigenfunctions + 6 + 6 * OCTAVES) float
    """
    count = min(eigenfunctions, mesh.n_vertices - 1)
    basis = np.zeros((mesh.n_vertices, eigenfunctions))
    if count > 0:
        _, vectors = mesh.eigenbasis(count + 1)
        # Unit mean square over the area, whatever the size of the mesh.
        basis[:, :count] = vectors[:, 1:] * np.sqrt(mesh.area)
    position = (mesh.vertices - mesh.vertices.mean(0)) / EXTENT
    waves = [wave(np.pi * 2.0**k * position) for k in range(OCTAVES) for wave in (np.sin, np.cos)]
    return np.concatenate([np.clip(basis, -4, 4), position, mesh.vertex_normals, *waves], axis=1)


class VertexTokens(nn.Module):
    """Tokens on a mesh: all of its vertices, or some with a fixed geometric prolongation to the others.

    Everything is a buffer, so that a checkpoint carries its mesh.

    Parameters
    ----------
    template : (V, 3) float
        Reference geometry of the full mesh, metres.
    faces : (F, 3) int
        Its triangles.
    edges : (E, 2) int
        Pairs of neighbouring tokens.
    descriptors : (N, C) float
        As `vertex_descriptors` makes them, for each token.
    amplitude : (N,) float
        Metres that one unit of network output moves each token.
    vertices : (N,) int
        The vertex that each token is.
    prolongation : SparseRows, optional
        (V, N), tokens to vertices; not given where every vertex is a token.
    """

    template: Tensor
    faces: Tensor
    edges: Tensor
    descriptors: Tensor
    amplitude: Tensor
    vertices: Tensor
    prolongation: SparseRows | None

    def __init__(
        self,
        template: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        edges: Int[Tensor, "edges 2"],
        descriptors: Float[Tensor, "tokens descriptors"],
        amplitude: Float[Tensor, " tokens"],
        vertices: Int[Tensor, " tokens"],
        prolongation: SparseRows | None = None,
    ):
        super().__init__()
        self.register_buffer("template", template)
        self.register_buffer("faces", faces.to(torch.int32))
        self.register_buffer("edges", edges.to(torch.int32))
        self.register_buffer("descriptors", descriptors)
        self.register_buffer("amplitude", amplitude)
        self.register_buffer("vertices", vertices.to(torch.int64))
        self.prolongation = prolongation
        self._graphs: dict[tuple, MeshGraph] = {}

    @classmethod
    def from_mesh(
        cls,
        mesh: TriangleMesh,
        tokens: int | str = "vertices",
        eigenfunctions: int = 64,
        motion: Float[np.ndarray, "examples vertices 3"] | None = None,
    ) -> "VertexTokens":
        """Tokens of a mesh.

        Parameters
        ----------
        mesh : TriangleMesh
            Any topology; disconnected parts are kept.
        tokens : "vertices" or int
            One a vertex, or so many by `choose_tokens`.
        eigenfunctions : int
            As in `vertex_descriptors`.
        motion : (M, V, 3), optional
            Examples of motion for `choose_tokens`.
        """
        descriptors, vertices, edges = vertex_descriptors(mesh, eigenfunctions), None, mesh.edges
        spread = None
        if tokens != "vertices" and int(tokens) < mesh.n_vertices:
            chosen = choose_tokens(mesh, int(tokens), motion)
            vertices, edges, spread = chosen.vertices, chosen.edges, _rows(chosen.prolongation)
            descriptors = descriptors[vertices]
        return cls(
            torch.from_numpy(mesh.vertices.astype(np.float32)),
            torch.from_numpy(mesh.faces),
            torch.from_numpy(edges),
            torch.from_numpy(descriptors.astype(np.float32)),
            torch.full((len(descriptors),), 1e-3),
            torch.from_numpy(np.arange(mesh.n_vertices) if vertices is None else vertices),
            spread,
        )

    @classmethod
    def from_state(cls, state: dict[str, Tensor]) -> "VertexTokens":
        """Rebuild what `state_dict` described.

        Raises
        ------
        FileFormatError
            If an entry is missing.
        """
        try:
            names = ("template", "faces", "edges", "descriptors", "amplitude", "vertices")
            prolongation = None
            if "prolongation.values" in state:
                rows, columns, values = (state[f"prolongation.{k}"] for k in ("rows", "columns", "values"))
                shape = (len(state["template"]), len(state["vertices"]))
                prolongation = SparseRows(rows, columns, values, shape)
            template, faces, edges, descriptors, amplitude, vertices = (state[name] for name in names)
            return cls(template, faces, edges, descriptors, amplitude, vertices, prolongation)
        except KeyError as error:
            raise FileFormatError(f"the checkpoint lacks surface.{error.args[0]}") from error

    @property
    def n_vertices(self) -> int:
        return len(self.template)

    @property
    def n_tokens(self) -> int:
        return len(self.descriptors)

    @property
    def mesh(self) -> TriangleMesh:
        """The full mesh at its reference geometry."""
        return TriangleMesh(self.template.cpu().numpy(), self.faces.cpu().numpy())

    def graph(self, rings: int, self_loops: bool, global_token: bool) -> MeshGraph:
        """The attention pattern over the tokens, kept for each device."""
        key = (rings, self_loops, global_token, self.edges.device)
        if key not in self._graphs:
            with torch.inference_mode(False):
                edges = self.edges.cpu().numpy()
                graph = MeshGraph.from_edges(edges, self.n_tokens, rings, self_loops, global_token)
                self._graphs[key] = graph.to(self.edges.device)
        return self._graphs[key]

    def identity(self, templates: Float[Tensor, "subjects vertices 3"]) -> Float[Tensor, "subjects tokens 3"]:
        """How subjects differ from the reference at each token, in centimetres."""
        return (templates - self.template)[:, self.vertices] * 100

    def prolong(self, moved: Float[Tensor, "batch tokens 3"]) -> Float[Tensor, "batch vertices 3"]:
        """Displacements of the tokens to displacements of all vertices."""
        return moved.float() if self.prolongation is None else self.prolongation(moved)


def _rows(matrix: sp.csr_array) -> SparseRows:
    entries = matrix.tocoo()
    rows, columns, values = (torch.from_numpy(a) for a in (entries.row, entries.col, entries.data))
    return SparseRows(rows, columns, values, matrix.shape)
