"""`MeshGraph`: which vertex attends to which, as sparse rows and their transpose."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Int
from scipy.sparse.csgraph import reverse_cuthill_mckee
from torch import Tensor

from meshanim.errors import MeshError, OptionError, ShapeError

__all__ = ["MeshGraph", "locality_order"]

# Rows further apart than this seldom share a cache. Reading in sequence outweighs a better order of visits
# until most neighbours are that far: at 100,000 vertices in random numbering it wins by a third;
# in the numbering that decimation leaves there, and on meshes that fit a cache, it loses.
FAR = 4096


@dataclass(frozen=True, eq=False)
class MeshGraph:
    """Allowed pairs of query and key, one edge a pair, sorted by query; make it with `from_faces`.

    Rows are stored in the order in which the kernels visit them. That is the mesh's own numbering, or, where
    most neighbours are far apart in it, reverse Cuthill-McKee; features stay in the mesh's numbering either
    way. A model that numbers its tokens by `locality_order` from the start runs faster still. All tensors are
    int32.

    The global token, where there is one, is the last token. It attends to all tokens, itself included, and
    no vertex attends to it. Its row is implied, not stored.

    Parameters
    ----------
    n_vertices : int
        Vertices V, without the global token.
    global_token : bool
        Whether token V is the global token.
    order : (V,)
        The vertex of each row.
    offsets : (V + 1,)
        Row r holds edges offsets[r] to offsets[r + 1].
    queries, keys : (E,)
        The vertices of each edge.
    received_offsets : (V + 1,)
        The transpose: the vertex order[r] is the key of the edges
        received_edges[received_offsets[r] : received_offsets[r + 1]].
    received_edges : (E,)
        Edges sorted by key.
    received_queries : (E,)
        queries[received_edges].
    """

    n_vertices: int
    global_token: bool
    order: Int[Tensor, " vertices"]
    offsets: Int[Tensor, " rows"]
    queries: Int[Tensor, " edges"]
    keys: Int[Tensor, " edges"]
    received_offsets: Int[Tensor, " rows"]
    received_edges: Int[Tensor, " edges"]
    received_queries: Int[Tensor, " edges"]

    @classmethod
    def from_faces(
        cls,
        faces: Int[np.ndarray, "faces corners"] | Int[Tensor, "faces corners"],
        rings: int = 1,
        self_loops: bool = True,
        global_token: bool = True,
        n_vertices: int | None = None,
    ) -> "MeshGraph":
        """A vertex attends to the vertices within `rings` edges of it (GAVA, Sec. III-D).

        Parameters
        ----------
        faces : (F, 3) int
            Triangles; quads (F, 4) too, whose sides count as edges and whose diagonals do not.
        rings : int
            1 for direct neighbours, k for all vertices within k edges.
        self_loops : bool
            Whether a vertex attends to itself. False is the paper's literal adjacency matrix.
        global_token : bool
            Whether one more token sees all and is seen by none (the paper's pose token).
        n_vertices : int, optional
            Give it where the last vertices may be in no face; otherwise the largest index in `faces` + 1.

        Raises
        ------
        ShapeError, MeshError, OptionError
            On a wrong shape, an index out of range, or rings below 1.
        """
        faces = np.asarray(faces.cpu() if isinstance(faces, Tensor) else faces)
        if faces.ndim != 2 or faces.shape[1] < 3:
            raise ShapeError(f"faces must have shape (n, 3), not {faces.shape}")
        edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
        return cls.from_edges(edges, n_vertices, rings, self_loops, global_token)

    @classmethod
    def from_edges(
        cls,
        edges: Int[np.ndarray, "edges 2"] | Int[Tensor, "edges 2"],
        n_vertices: int | None = None,
        rings: int = 1,
        self_loops: bool = True,
        global_token: bool = True,
        directed: bool = False,
    ) -> "MeshGraph":
        """The same from pairs of vertices; repeated pairs count once.

        Parameters
        ----------
        edges : (E, 2) int
            Pairs that attend to each other or, where `directed`, (query, key).
        n_vertices, rings, self_loops, global_token
            As in `from_faces`. A pair (i, i) counts only as `self_loops` says.
        directed : bool
            Whether a pair allows only its first vertex to attend to its second.
        """
        edges = np.asarray(edges.cpu() if isinstance(edges, Tensor) else edges)
        if edges.ndim != 2 or edges.shape[1] != 2:
            raise ShapeError(f"edges must have shape (n, 2), not {edges.shape}")
        if rings < 1:
            raise OptionError(f"rings must be at least 1, not {rings}")
        n = n_vertices if n_vertices is not None else int(edges.max(initial=-1)) + 1
        if edges.size and (edges.min() < 0 or edges.max() >= n):
            raise MeshError(f"edges name vertices {edges.min()}..{edges.max()}, but there are {n}")
        step = _pattern(edges[:, 0], edges[:, 1], n)
        if not directed:
            step = _pattern_of(step + step.T)
        reach = step
        for _ in range(rings - 1):
            reach = _pattern_of(reach + reach @ step)
        queries, keys = reach.nonzero()
        outer = queries != keys
        loop = np.arange(n if self_loops else 0)
        return cls._from_pairs(
            np.concatenate([queries[outer], loop]), np.concatenate([keys[outer], loop]), n, global_token
        )

    @classmethod
    def _from_pairs(cls, queries: np.ndarray, keys: np.ndarray, n: int, global_token: bool) -> "MeshGraph":
        far = np.abs(queries - keys)[queries != keys] > FAR
        order = np.arange(n) if not far.size or far.mean() <= 0.5 else locality_order(queries, keys, n)
        rank = np.empty(n, np.int64)
        rank[order] = np.arange(n)
        by_query = np.lexsort((rank[keys], rank[queries]))
        queries, keys = queries[by_query], keys[by_query]
        received = np.lexsort((rank[queries], rank[keys]))

        def offsets(rows: np.ndarray) -> np.ndarray:
            return np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])

        columns = (
            order,
            offsets(rank[queries]),
            queries,
            keys,
            offsets(rank[keys]),
            received,
            queries[received],
        )
        return cls(n, global_token, *(torch.from_numpy(column.astype(np.int32)) for column in columns))

    @property
    def n_tokens(self) -> int:
        """Vertices, and the global token where there is one."""
        return self.n_vertices + self.global_token

    @property
    def n_edges(self) -> int:
        """Allowed pairs among the vertices; the global token's own row is not counted."""
        return len(self.keys)

    @property
    def device(self) -> torch.device:
        return self.keys.device

    def to(self, device: str | torch.device) -> "MeshGraph":
        """The same graph on another device; itself where it is there already."""
        if self.device == torch.device(device):
            return self
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {
            name: value.to(device) for name, value in values.items() if isinstance(value, Tensor)
        }
        return replace(self, **moved)

    def allowed(self) -> Bool[Tensor, "tokens tokens"]:
        """Dense mask of (query, key), for tests and small meshes: quadratic in the vertices."""
        mask = torch.zeros(self.n_tokens, self.n_tokens, dtype=torch.bool, device=self.device)
        mask[self.queries.long(), self.keys.long()] = True
        if self.global_token:
            mask[-1] = True
        return mask


def locality_order(
    queries: Int[np.ndarray, " edges"], keys: Int[np.ndarray, " edges"], n_vertices: int
) -> Int[np.ndarray, " vertices"]:
    """The vertices in an order in which neighbours are close (reverse Cuthill-McKee)."""
    pattern = _pattern(queries, keys, n_vertices)
    order = reverse_cuthill_mckee(_pattern_of(pattern + pattern.T), symmetric_mode=True)
    return order.astype(np.int64)


def _pattern(rows: np.ndarray, columns: np.ndarray, n: int) -> sp.csr_array:
    return _pattern_of(sp.csr_array((np.ones(len(rows), bool), (rows, columns)), shape=(n, n)))


def _pattern_of(matrix: sp.csr_array) -> sp.csr_array:
    matrix = sp.csr_array(matrix, dtype=bool)
    matrix.sum_duplicates()
    return matrix
