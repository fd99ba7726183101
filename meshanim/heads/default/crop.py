"""Cut the head off the base mesh along a closed edge loop of the neck, and lay its texture atlas out."""

from collections import defaultdict

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from meshanim.errors import MeshError

__all__ = ["atlas", "edge_loop", "neck_crop", "uv_islands"]

Quads = Int[np.ndarray, "quads 4"]
Points = Float[np.ndarray, "vertices 3"]


def _edge_quads(quads: Quads) -> dict[tuple[int, int], list[int]]:
    edges = defaultdict(list)
    for index, quad in enumerate(quads.tolist()):
        for a, b in zip(quad, quad[1:] + quad[:1]):
            edges[min(a, b), max(a, b)].append(index)
    return edges


def edge_loop(quads: Quads, start: int, second: int) -> list[int] | None:
    """Walk straight on from an edge through vertices of four quads; the closed loop, or None if it ends."""
    edges = _edge_quads(quads)
    around = defaultdict(list)
    for index, quad in enumerate(quads.tolist()):
        for vertex in quad:
            around[vertex].append(index)
    loop = [start, second]
    while len(loop) <= len(quads):
        a, b = loop[-2:]
        opposite = [quad for quad in around[b] if quad not in edges[min(a, b), max(a, b)]]
        if len(around[b]) != 4 or len(opposite) != 2:
            return None
        shared = set(quads[opposite[0]].tolist()) & set(quads[opposite[1]].tolist()) - {b}
        if len(shared) != 1:
            return None
        following = shared.pop()
        if following == start:
            return loop
        loop.append(following)
    return None


def neck_crop(vertices: Points, quads: Quads, height: float) -> tuple[Quads, list[int]]:
    """The quads above the closed loop of the neck that crosses the back mid-line nearest to `height`, metres.

    Returns
    -------
    keep : (Q,) int
        Indices of the kept quads.
    loop : list of int
        The vertices of the cut, in order.
    """
    edges = _edge_quads(quads)
    middle = np.abs(vertices[:, 0]) < 1e-4
    starts = [
        (abs(vertices[a, 1] - height), a, b)
        for edge in edges
        for a, b in (edge, edge[::-1])
        if middle[a] and not middle[b] and vertices[a, 2] < -0.09 and abs(vertices[a, 1] - height) < 0.06
    ]
    loop = next((found for _, a, b in sorted(starts) if (found := edge_loop(quads, a, b))), None)
    if loop is None:
        raise MeshError(f"no closed edge loop crosses the back of the neck near y = {height}")
    cut = {(min(a, b), max(a, b)) for a, b in zip(loop, loop[1:] + loop[:1])}
    pairs = np.array([owners for edge, owners in edges.items() if len(owners) == 2 and edge not in cut])
    graph = sp.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(quads), len(quads)))
    _, label = sp.csgraph.connected_components(graph, directed=False)
    highest = vertices[quads].mean(1)[:, 1].argmax()
    return np.flatnonzero(label == label[highest]), loop


def uv_islands(uv_quads: Quads) -> Int[np.ndarray, " quads"]:
    """Island of each quad in texture space, the largest first."""
    n = uv_quads.max() + 1
    rows, columns = uv_quads[:, :3].ravel(), uv_quads[:, 1:].ravel()
    _, label = sp.csgraph.connected_components(
        sp.coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)), directed=False
    )
    _, island, counts = np.unique(label[uv_quads[:, 0]], return_inverse=True, return_counts=True)
    return np.argsort(np.argsort(-counts, kind="stable"))[island]


# Boxes (left, bottom, right, top) in the atlas: face, mouth cavity, two eye sockets, neck.
SKIN_BOXES = (
    (0.004, 0.004, 0.53, 0.996),
    (0.545, 0.004, 0.8, 0.35),
    (0.83, 0.004, 0.99, 0.17),
    (0.83, 0.18, 0.99, 0.35),
    (0.545, 0.37, 0.995, 0.995),
)
# Monotone stretch of the face island, old position -> new, so that eyes, nose and mouth get more texels.
STRETCH_V = ([0, 0.20, 0.335, 0.42, 0.58, 0.665, 0.80, 1], [0, 0.09, 0.21, 0.33, 0.67, 0.79, 0.91, 1])
STRETCH_U = ([0, 0.2, 0.36, 0.6, 0.72, 0.84, 1], [0, 0.09, 0.20, 0.52, 0.72, 0.88, 1])


def atlas(uv: Float[np.ndarray, "uv 2"], uv_quads: Quads) -> Float[np.ndarray, "uv 2"]:
    """Pack the islands of the cropped skin into the unit square, the middle of the face magnified."""
    island = uv_islands(uv_quads)
    packed = uv.copy()
    if island.max() + 1 != len(SKIN_BOXES):
        raise MeshError(f"the skin has {island.max() + 1} texture islands, expected {len(SKIN_BOXES)}")
    for index, box in enumerate(SKIN_BOXES):
        rows = np.unique(uv_quads[island == index])
        low, high = uv[rows].min(0), uv[rows].max(0)
        corner, size = np.array(box[:2]), np.subtract(box[2:], box[:2])
        packed[rows] = corner + (uv[rows] - low) * (size / (high - low)).min()
    face = np.unique(uv_quads[island == 0])
    corner, size = np.array(SKIN_BOXES[0][:2]), np.subtract(SKIN_BOXES[0][2:], SKIN_BOXES[0][:2])
    unit = (packed[face] - corner) / size
    unit = np.stack([np.interp(unit[:, 0], *STRETCH_U), np.interp(unit[:, 1], *STRETCH_V)], axis=1)
    packed[face] = corner + unit * size
    return packed
