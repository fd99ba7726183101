import subprocess
import sys

import numpy as np
import pytest
import torch
from dense_attention import dense_attention, random_inputs, sphere
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.attention import MeshAttention, MeshGraph, mesh_attention
from meshanim.attention import native as native_module
from meshanim.errors import BackendError

_native = pytest.importorskip("meshanim._native", reason="the extension was not built")
SETS = ("generic", "avx2", "avx512")
AVAILABLE = SETS[: SETS.index(_native.instruction_set()) + 1]


@pytest.fixture(params=AVAILABLE)
def instruction_set(request):
    _native.set_instruction_set(request.param)
    yield request.param
    _native.set_instruction_set(AVAILABLE[-1])


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def gradients(out, inputs, seed=1):
    weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.autograd.grad((out * weight.to(out.dtype)).sum(), inputs)


def assert_equals_dense(graph, inputs, tolerance=1e-5):
    out = mesh_attention(*inputs, graph, backend="native")
    exact = [tensor.detach().double().requires_grad_() for tensor in inputs]
    expected = dense_attention(*exact, graph)
    for ours, theirs in zip([out, *gradients(out, inputs)], [expected, *gradients(expected, exact)]):
        assert torch.allclose(ours.double(), theirs, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize(
    ("heads", "dim"), [(4, 16), (1, 64), (8, 32), (2, 128), (3, 5), (5, 8), (17, 4), (16, 1)]
)
@pytest.mark.parametrize("global_token", [True, False])
def test_equals_dense_attention(instruction_set, heads, dim, global_token):
    graph = MeshGraph.from_faces(sphere(2)[1], global_token=global_token)
    assert_equals_dense(graph, random_inputs(graph, 2, heads, dim))


@pytest.mark.parametrize("dim", range(1, 68))
def test_any_head_dimension(dim):
    graph = MeshGraph.from_faces(sphere(1)[1], rings=2)
    assert_equals_dense(graph, random_inputs(graph, 2, 1 + dim % 5, dim))


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 150),
    density=st.floats(0, 3),
    seed=st.integers(0, 2**16),
    heads=st.sampled_from([1, 3, 4]),
    dim=st.sampled_from([3, 16]),
    self_loops=st.booleans(),
    global_token=st.booleans(),
    directed=st.booleans(),
)
def test_random_graphs(n, density, seed, heads, dim, self_loops, global_token, directed):
    edges = np.random.default_rng(seed).integers(0, n, (int(density * n), 2))
    graph = MeshGraph.from_edges(
        edges, n, self_loops=self_loops, global_token=global_token, directed=directed
    )
    assert_equals_dense(graph, random_inputs(graph, 1, heads, dim, seed=seed))


def test_a_row_longer_than_any_buffer():
    star = np.stack([np.zeros(999, np.int64), np.arange(1, 1000)], 1)
    graph = MeshGraph.from_edges(star, 1000)
    assert_equals_dense(graph, random_inputs(graph, 1, 4, 16))


def test_rows_visited_in_another_order():
    n = 30_000
    ring = np.random.default_rng(0).permutation(n)
    graph = MeshGraph.from_edges(np.stack([ring, np.roll(ring, 1)], 1), n)
    assert (graph.order != torch.arange(n)).any()
    inputs = random_inputs(graph, 1, 4, 16)
    out = mesh_attention(*inputs, graph, backend="native")
    exact = [tensor.detach().double().requires_grad_() for tensor in inputs]
    expected = mesh_attention(*exact, graph, backend="reference")
    for ours, theirs in zip([out, *gradients(out, inputs)], [expected, *gradients(expected, exact)]):
        assert torch.allclose(ours.double(), theirs, atol=1e-5)


def test_isolated_vertices_without_self_loops_get_zeros():
    graph = MeshGraph.from_edges(np.array([[0, 1]]), 4, self_loops=False, global_token=False)
    inputs = random_inputs(graph, 2, 4, 16)
    for backend in ("native", "reference"):
        out = mesh_attention(*inputs, graph, backend=backend)
        assert (out[:, 2:] == 0).all()
        assert (out[:, :2] != 0).any()
        for gradient in gradients(out, inputs):
            assert torch.isfinite(gradient).all()
            assert (gradient[:, 2:] == 0).all()


@pytest.mark.parametrize(("batch", "vertices"), [(0, 5), (2, 0)])
def test_nothing_in_nothing_out(batch, vertices):
    edges = np.zeros((0, 2), np.int64)
    for global_token in (True, False):
        graph = MeshGraph.from_edges(edges, vertices, global_token=global_token)
        inputs = random_inputs(graph, batch, 4, 16)
        for backend in ("native", "reference"):
            out = mesh_attention(*inputs, graph, backend=backend)
            assert out.shape == (batch, graph.n_tokens, 4, 16)
            assert [gradient.shape for gradient in gradients(out, inputs)] == [out.shape] * 3
            if out.numel():
                assert torch.allclose(out, inputs[2])


def test_bitwise_the_same_for_any_number_of_threads(instruction_set, threads):
    graph = MeshGraph.from_faces(sphere(3)[1])
    inputs = random_inputs(graph, 3, 4, 16)
    results = []
    for count in (1, 2, 3):
        threads(count)
        out = mesh_attention(*inputs, graph, backend="native")
        results.append([out, *gradients(out, inputs)])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_large_outputs_from_the_pool_are_right(monkeypatch):
    n = 33_000  # rows of 4 x 4 x 16 floats: large enough to be written past the caches
    strip = np.stack([np.arange(n - 1), np.arange(1, n)], 1)
    graph = MeshGraph.from_edges(strip, n)
    inputs = random_inputs(graph, 4, 4, 16)
    pooled = mesh_attention(*inputs, graph, backend="native")
    results = [pooled, *gradients(pooled, inputs)]
    monkeypatch.setattr(native_module, "POOLED", 1 << 62)
    plain = mesh_attention(*inputs, graph, backend="native")
    for ours, theirs in zip(results, [plain, *gradients(plain, inputs)]):
        assert torch.equal(ours, theirs)
    expected = mesh_attention(*(tensor.detach() for tensor in inputs), graph, backend="reference")
    assert torch.allclose(pooled, expected, atol=1e-5)


def test_pool_reuses_and_holds_little_more_than_was_in_use():
    block = 1 << 20
    first = _native.empty([block])
    address = first.data_ptr()
    kept = first[7:].fill_(3.0)
    del first
    other = _native.empty([block]).fill_(5.0)
    assert other.data_ptr() != address, "a view keeps its buffer"
    assert (kept == 3).all()
    del kept
    assert _native.empty([block]).data_ptr() in (address, other.data_ptr())
    tensors = [_native.empty([scale * block]) for scale in (1, 2, 3)]
    del tensors, other
    for scale in (1, 2, 3, 4, 5):
        _native.empty([scale * block])
        used, idle, most = _native.pool_bytes()
        assert used + idle <= 1.25 * most
    with pytest.raises(ValueError, match="at least one element"):
        _native.empty([3, 0])


def test_without_gradients_the_same_output():
    graph = MeshGraph.from_faces(sphere(2)[1])
    inputs = random_inputs(graph, 2, 4, 16)
    with torch.no_grad():
        quiet = mesh_attention(*inputs, graph)
    assert torch.equal(quiet, mesh_attention(*inputs, graph))
    assert not quiet.requires_grad


def test_views_of_any_stride_are_read_right():
    graph = MeshGraph.from_faces(sphere(2)[1])
    plain = [tensor.detach() for tensor in random_inputs(graph, 2, 4, 16)]
    expected = mesh_attention(*plain, graph)
    fused = torch.stack(plain, 2)
    assert torch.equal(mesh_attention(*fused.unbind(2), graph), expected)
    heads_first = [tensor.transpose(1, 2).contiguous().transpose(1, 2) for tensor in plain]
    assert torch.equal(mesh_attention(*heads_first, graph), expected)
    batch_last = [tensor.permute(1, 2, 3, 0).contiguous().permute(3, 0, 1, 2) for tensor in plain]
    assert torch.equal(mesh_attention(*batch_last, graph), expected)
    query = plain[0].requires_grad_()
    (ones,) = torch.autograd.grad(mesh_attention(query, *plain[1:], graph).sum(), query)
    (weighted,) = torch.autograd.grad(
        mesh_attention(query, *plain[1:], graph), query, torch.ones_like(expected)
    )
    assert torch.equal(ones, weighted)


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nan_and_infinity_are_not_hidden(instruction_set, which, value):
    graph = MeshGraph.from_faces(sphere(2)[1])
    inputs = [tensor.detach() for tensor in random_inputs(graph, 1, 4, 16)]
    inputs[which][0, 7, 2, 3] = value
    ours = mesh_attention(*inputs, graph, backend="native").isfinite()
    theirs = mesh_attention(*inputs, graph, backend="reference").isfinite()
    assert torch.equal(ours, theirs)
    assert not ours.all()


def test_scores_far_apart_do_not_overflow(instruction_set):
    graph = MeshGraph.from_faces(sphere(2)[1])
    query, key, value = (tensor.detach() for tensor in random_inputs(graph, 1, 4, 16))
    out = mesh_attention(100 * query, 100 * key, value, graph, backend="native")
    expected = dense_attention(100 * query.double(), 100 * key.double(), value.double(), graph)
    assert torch.allclose(out.double(), expected, atol=2e-3)


def test_exponential_within_two_ulp(instruction_set):
    special = torch.tensor([float("nan"), float("inf"), -float("inf"), 0.0, 1.0, -200.0, 200.0])
    x = torch.cat([special, torch.linspace(-105.0, 88.7, 300_001)])
    y = torch.empty_like(x)
    _native.exponential(x, y)
    exact = np.exp(x.numpy().astype(np.float64))
    with np.errstate(over="ignore"):
        spacing = np.spacing(exact.astype(np.float32)).astype(np.float64)
    assert y[0].isnan()
    assert y[1:7].tolist() == [np.inf, 0.0, 1.0, pytest.approx(np.e, rel=2e-7), 0.0, np.inf]
    assert (np.abs(y.numpy()[7:] - exact[7:]) <= 2 * spacing[7:]).all()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_types_are_computed_in_float32(dtype):
    graph = MeshGraph.from_faces(sphere(2)[1])
    inputs = [tensor.detach().to(dtype).requires_grad_() for tensor in random_inputs(graph, 1, 4, 16)]
    out = mesh_attention(*inputs, graph, backend="native")
    assert out.dtype == dtype
    wide = [tensor.detach().float().requires_grad_() for tensor in inputs]
    expected = mesh_attention(*wide, graph, backend="native")
    assert torch.equal(out, expected.to(dtype))
    for ours, theirs in zip(gradients(out, inputs), gradients(expected, wide)):
        assert ours.dtype == dtype
        assert torch.allclose(ours.float(), theirs, atol=3e-2, rtol=3e-2)


def test_autocast_trains():
    graph = MeshGraph.from_faces(sphere(2)[1])
    layer = MeshAttention(64)
    tokens = torch.randn(2, graph.n_tokens, 64)
    expected = layer(tokens, graph)
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(tokens, graph)
        out.float().square().mean().backward()
    assert out.dtype == torch.bfloat16
    assert torch.allclose(out.float(), expected, atol=3e-2)
    assert layer.project_in.weight.grad.isfinite().all()
    assert layer.project_in.weight.grad.abs().max() > 0


COMPILED = """
import numpy as np, sys, torch
from meshanim.attention import MeshAttention, MeshGraph

grid = np.arange(30).reshape(5, 6)
corners = [grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]]
graph = MeshGraph.from_faces(np.stack([corner.ravel() for corner in corners], 1))
layer = MeshAttention(32, heads=2)
tokens = torch.randn(2, graph.n_tokens, 32)
compiled = torch.compile(layer, backend=sys.argv[1], fullgraph=True)
expected, out = layer(tokens, graph), compiled(tokens, graph)
torch.testing.assert_close(out, expected, atol=1e-5, rtol=1e-5)
ours = torch.autograd.grad(out.square().sum(), list(layer.parameters()))
theirs = torch.autograd.grad(expected.square().sum(), list(layer.parameters()))
torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
    torch.testing.assert_close(compiled(tokens, graph), layer(tokens, graph), atol=3e-2, rtol=3e-2)
"""


def test_compiles_without_a_graph_break():
    # A process of its own: the shape checks of the tests cannot be traced. The backend without a C++ compiler
    # asks the same of the operators as inductor does, in a tenth of the time.
    subprocess.run([sys.executable, "-c", COMPILED, "aot_eager"], check=True, cwd="/")


def test_operators_follow_torchs_rules():
    graph = MeshGraph.from_faces(sphere(1)[1])
    arrays = (graph.order, graph.offsets, graph.keys)
    arrays += (graph.received_offsets, graph.received_edges, graph.received_queries)
    arguments = (*random_inputs(graph, 1, 2, 4), *arrays, True, 0.5, True)
    torch.library.opcheck(torch.ops.meshanim.mesh_attention.default, arguments)


def test_second_derivatives_are_refused_by_native_and_given_by_reference():
    graph = MeshGraph.from_faces(sphere(1)[1])
    query, key, value = random_inputs(graph, 1, 2, 4)
    for backend, known in (("reference", True), ("native", False)):
        out = mesh_attention(query, key, value, graph, backend=backend)
        (first,) = torch.autograd.grad(out.square().sum(), query, create_graph=True)
        if known:
            assert torch.autograd.grad(first.square().sum(), key)[0].abs().max() > 0
        else:
            with pytest.raises(RuntimeError, match="differentiated once"):
                torch.autograd.grad(first.square().sum(), key)


def test_backends_are_chosen_and_refused(monkeypatch):
    graph = MeshGraph.from_faces(sphere(1)[1])
    inputs = random_inputs(graph, 1, 2, 4, dtype=torch.float64)
    with pytest.raises(BackendError, match=r"float32 on the CPU, not torch\.float64"):
        mesh_attention(*inputs, graph, backend="native")
    exact = mesh_attention(*inputs, graph)
    assert torch.equal(exact, mesh_attention(*inputs, graph, backend="reference"))
    with pytest.raises(BackendError, match="NVIDIA"):
        mesh_attention(*inputs, graph, backend="cuda")
    narrow = [tensor.detach().float() for tensor in inputs]
    assert torch.equal(mesh_attention(*narrow, graph), mesh_attention(*narrow, graph, backend="native"))
    monkeypatch.setattr(native_module, "_native", None)
    assert torch.equal(mesh_attention(*narrow, graph), mesh_attention(*narrow, graph, backend="reference"))
    with pytest.raises(BackendError, match=r"not built.*reference"):
        mesh_attention(*narrow, graph, backend="native")


@pytest.mark.cuda
def test_cuda_equals_dense_attention():
    graph = MeshGraph.from_faces(sphere(2)[1]).to("cuda")
    inputs = [tensor.detach().cuda().requires_grad_() for tensor in random_inputs(graph, 2, 4, 16)]
    exact = [tensor.detach().double().requires_grad_() for tensor in inputs]
    out = mesh_attention(*inputs, graph, backend="cuda")
    expected = dense_attention(*exact, graph)
    assert torch.allclose(out.double(), expected, atol=1e-5)
    for ours, theirs in zip(
        torch.autograd.grad(out.square().sum(), inputs), torch.autograd.grad(expected.square().sum(), exact)
    ):
        assert torch.allclose(ours.double(), theirs, atol=1e-4)
