import copy
import pickle

import numpy as np
import pytest
import torch
from dense_attention import dense_attention, random_inputs, sphere

from meshanim.attention import MeshAttention, MeshGraph, attention_maps, mesh_attention
from meshanim.errors import OptionError, ShapeError


@pytest.mark.parametrize("self_loops", [True, False])
@pytest.mark.parametrize("global_token", [True, False])
@pytest.mark.parametrize("rings", [1, 2])
def test_equals_dense_attention_forward_and_backward(self_loops, global_token, rings):
    graph = MeshGraph.from_faces(sphere(1)[1], rings, self_loops, global_token)
    inputs = random_inputs(graph, batch=2, heads=3, dim=5, dtype=torch.float64)
    out = mesh_attention(*inputs, graph, backend="reference")
    expected = dense_attention(*inputs, graph)
    assert torch.allclose(out, expected, atol=1e-12, rtol=0)
    weight = torch.randn_like(out)
    for ours, theirs in zip(
        torch.autograd.grad((out * weight).sum(), inputs),
        torch.autograd.grad((expected * weight).sum(), inputs),
    ):
        assert torch.allclose(ours, theirs, atol=1e-12, rtol=0)


def test_gradcheck():
    graph = MeshGraph.from_faces(np.array([[0, 1, 2], [2, 1, 3]]), n_vertices=5)
    inputs = random_inputs(graph, batch=2, heads=2, dim=3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda *qkv: mesh_attention(*qkv, graph, backend="reference"), inputs)


def test_forbidden_tokens_have_no_influence():
    faces = sphere(1)[1]
    graph = MeshGraph.from_faces(faces)
    query, key, value = random_inputs(graph, batch=1, heads=2, dim=4, dtype=torch.float64)
    out = mesh_attention(query, key, value, graph)
    changed = value.detach().clone()
    changed[:, 7] += 1.0
    changed[:, -1] += 1.0
    moved = (mesh_attention(query, key, changed, graph) - out).abs().amax((0, 2, 3)) > 0
    assert (moved == graph.allowed()[:, [7, graph.n_vertices]].any(1)).all()


def test_maps_are_those_of_the_dense_matrix():
    graph = MeshGraph.from_faces(sphere(1)[1])
    query, key, _ = random_inputs(graph, batch=2, heads=3, dim=4, dtype=torch.float64)
    scores = torch.einsum("bihd,bjhd->bhij", query, key) / 2
    matrix = scores.masked_fill(~graph.allowed(), -torch.inf).softmax(-1)
    maps = attention_maps(query, key, graph)
    n = graph.n_vertices
    assert torch.allclose(maps.received, matrix[:, :, :n, :n].amax(2).transpose(1, 2), atol=1e-12)
    assert torch.allclose(maps.global_row, matrix[:, :, n, :n].transpose(1, 2), atol=1e-12)
    bare = MeshGraph.from_faces(sphere(1)[1], global_token=False)
    assert attention_maps(query[:, :-1], key[:, :-1], bare).global_row is None


def test_layer_is_projection_attention_projection():
    graph = MeshGraph.from_faces(sphere(1)[1])
    layer = MeshAttention(12, heads=3).double()
    tokens = torch.randn(2, graph.n_tokens, 12, dtype=torch.float64)
    query, key, value = (part.unflatten(-1, (3, 4)) for part in layer.project_in(tokens).chunk(3, -1))
    expected = layer.project_out(dense_attention(query, key, value, graph).flatten(2))
    assert torch.allclose(layer(tokens, graph), expected, atol=1e-12)
    assert torch.equal(layer.maps(tokens, graph).received, attention_maps(query, key, graph).received)
    clones = copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)), MeshAttention(12, heads=3).double()
    clones[2].load_state_dict(layer.state_dict())
    for clone in clones:
        assert torch.equal(clone(tokens, graph), layer(tokens, graph))
    assert torch.equal(layer(tokens, pickle.loads(pickle.dumps(copy.deepcopy(graph)))), layer(tokens, graph))


def test_layer_drops_only_while_training():
    graph = MeshGraph.from_faces(sphere(1)[1])
    layer = MeshAttention(8, heads=2, dropout=0.5)
    tokens = torch.randn(1, graph.n_tokens, 8)
    assert (layer(tokens, graph) == 0).float().mean() > 0.3
    assert torch.equal(layer.eval()(tokens, graph), layer(tokens, graph))


def test_bad_input_is_named():
    graph = MeshGraph.from_faces(sphere(1)[1])
    query, key, value = random_inputs(graph, batch=1, heads=2, dim=4)
    with pytest.raises(ShapeError, match="42 vertices and the global token"):
        mesh_attention(query[:, :-1], key[:, :-1], value[:, :-1], graph)
    with pytest.raises(OptionError, match="'fast' is not one of auto, native, cuda, reference"):
        mesh_attention(query, key, value, graph, backend="fast")
    with pytest.raises(ShapeError, match=r"graph\.to"):
        mesh_attention(query, key, value, graph.to("meta"))
    with pytest.raises(OptionError, match="multiple"):
        MeshAttention(10, heads=4)
    with pytest.raises(ShapeError, match="12 features, not 10"):
        MeshAttention(12)(torch.zeros(1, graph.n_tokens, 10), graph)
