import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from meshanim.attention import MeshGraph
from meshanim.errors import MeshError, OptionError, ShapeError

STRIP = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4]])


def dense(graph):
    return graph.allowed().numpy()


def test_neighbours_of_a_strip():
    expected = np.eye(6, dtype=bool)
    for a, b in [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4)]:
        expected[a, b] = expected[b, a] = True
    expected[5] = True
    graph = MeshGraph.from_faces(STRIP)
    assert (dense(graph) == expected).all()
    assert (graph.n_tokens, graph.n_vertices, graph.n_edges) == (6, 5, 19)
    literal = MeshGraph.from_faces(STRIP, self_loops=False)
    assert (dense(literal)[:5, :5] == (expected & ~np.eye(6, dtype=bool))[:5, :5]).all()
    assert dense(literal)[5].all()
    assert not dense(graph)[:5, 5].any(), "no vertex attends to the global token"
    assert (dense(MeshGraph.from_faces(STRIP, global_token=False)) == expected[:5, :5]).all()


def test_rings_are_distances():
    graph = MeshGraph.from_faces(STRIP, rings=2, global_token=False)
    expected = np.ones((5, 5), bool)
    expected[0, 4] = expected[4, 0] = True
    assert (dense(graph) == expected).all()
    path = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    for rings in (1, 2, 3):
        reach = dense(MeshGraph.from_edges(path, rings=rings, global_token=False))
        assert (reach == (np.abs(np.subtract.outer(range(5), range(5))) <= rings)).all()


def test_directed_edges_and_quads():
    graph = MeshGraph.from_edges(np.array([[0, 1]]), directed=True, self_loops=False, global_token=False)
    assert dense(graph).tolist() == [[False, True], [False, False]]
    quad = MeshGraph.from_faces(np.array([[0, 1, 2, 3]]), global_token=False)
    assert not dense(quad)[0, 2]
    assert dense(quad)[0].sum() == 3


@given(
    st.integers(0, 12).flatmap(
        lambda n: st.tuples(
            st.just(n),
            st.lists(st.tuples(st.integers(0, max(n - 1, 0)), st.integers(0, max(n - 1, 0))), max_size=3 * n),
        )
    ),
    st.booleans(),
    st.booleans(),
)
def test_transpose_and_rows_agree(shape, self_loops, directed):
    n, pairs = shape
    edges = np.array(pairs, np.int64).reshape(-1, 2)
    graph = MeshGraph.from_edges(edges, n, self_loops=self_loops, directed=directed)
    mask = np.zeros((n, n), bool)
    mask[edges[:, 0], edges[:, 1]] = True
    mask |= mask.T & (not directed)
    np.fill_diagonal(mask, self_loops)
    assert (dense(graph)[:n, :n] == mask).all()
    assert sorted(graph.order.tolist()) == list(range(n))
    for row, vertex in enumerate(graph.order.tolist()):
        edge = slice(graph.offsets[row], graph.offsets[row + 1])
        assert (graph.queries[edge] == vertex).all()
        assert sorted(graph.keys[edge].tolist()) == np.flatnonzero(mask[vertex]).tolist()
        received = slice(graph.received_offsets[row], graph.received_offsets[row + 1])
        edges_in = graph.received_edges[received].long()
        assert (graph.keys[edges_in] == vertex).all()
        assert (graph.queries[edges_in] == graph.received_queries[received]).all()
        assert sorted(graph.received_queries[received].tolist()) == np.flatnonzero(mask[:, vertex]).tolist()


def test_rows_are_visited_near_each_other_whatever_the_numbering():
    side = 160
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    assert (MeshGraph.from_faces(faces).order == torch.arange(side * side)).all()
    shuffled = np.random.default_rng(0).permutation(side * side)[faces]
    graph = MeshGraph.from_faces(shuffled)
    rank = torch.empty(side * side, dtype=torch.long)
    rank[graph.order.long()] = torch.arange(side * side)
    assert (rank[graph.queries.long()] - rank[graph.keys.long()]).abs().max() < 3 * side
    assert (rank[graph.queries.long()].diff() >= 0).all()


def test_indices_are_int32_and_move():
    graph = MeshGraph.from_faces(torch.from_numpy(STRIP), n_vertices=7)
    assert graph.n_vertices == 7
    assert graph.keys.dtype == graph.order.dtype == torch.int32
    assert graph.to("cpu") is graph
    assert graph.to("meta").received_edges.device.type == "meta"


def test_bad_input_is_named():
    with pytest.raises(MeshError, match=r"0\.\.4, but there are 3"):
        MeshGraph.from_faces(STRIP, n_vertices=3)
    with pytest.raises(OptionError, match="rings"):
        MeshGraph.from_faces(STRIP, rings=0)
    with pytest.raises(ShapeError, match=r"\(n, 3\)"):
        MeshGraph.from_faces(STRIP[:, :2])
