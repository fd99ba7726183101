"""How fast mesh attention is, against dense attention and the layer's own projection."""

import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from meshanim.attention.functional import mesh_attention
from meshanim.attention.graph import MeshGraph
from meshanim.attention.module import MeshAttention
from meshanim.results import Results

__all__ = ["BenchmarkOptions", "closed_mesh_faces", "run"]


@dataclass(frozen=True)
class BenchmarkOptions:
    """Time of mesh attention against dense attention and the layer's own projection.

    Example: meshanim bench attention --json attention.json
    """

    vertices: int = 5023
    """Vertices of the mesh that all implementations are compared on."""
    batch: int = 4
    heads: int = 4
    dim: int = 16
    """Features a head."""
    repeats: int = 9
    """Interleaved repeats; medians are reported."""
    scaling: tuple[int, ...] = (1_000, 5_000, 20_000, 50_000, 200_000)
    """Meshes on which the cost a vertex is measured."""
    memory_vertices: int = 200_000
    """Mesh of the training step whose peak memory is measured, in a process of its own; 0 for none."""
    seed: int = 0
    json: Path | None = None
    """Also write the rows here."""


def run(options: BenchmarkOptions | None = None) -> Results:
    """Measure and return the rows; milliseconds are medians of interleaved repeats."""
    options = options or BenchmarkOptions()
    results = Results("attention")
    torch.manual_seed(options.seed)
    _compare(options, results)
    for vertices in options.scaling:
        _scale(options, vertices, results)
    if options.memory_vertices:
        context = multiprocessing.get_context("spawn")
        with context.Pool(1) as pool:
            gigabytes = pool.apply(_peak_memory, (options, options.memory_vertices))
        case = f"{options.memory_vertices:,} vertices"
        results.add(case, "native", "training step peak memory", gigabytes, "GB")
    return results


def closed_mesh_faces(vertices: int) -> np.ndarray:
    """Triangles of a closed surface with exactly this many vertices, numbered by rings around an axis."""
    angle = np.pi * (3 - 5**0.5) * np.arange(vertices)
    height = 1 - 2 * (np.arange(vertices) + 0.5) / vertices
    radius = np.sqrt(1 - height**2)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)
    return ConvexHull(points).simplices.astype(np.int64)


def _compare(options: BenchmarkOptions, results: Results) -> None:
    graph = MeshGraph.from_faces(closed_mesh_faces(options.vertices), n_vertices=options.vertices)
    width = options.heads * options.dim
    shape = (options.batch, graph.n_tokens, options.heads, options.dim)
    inputs = [torch.randn(shape, requires_grad=True) for _ in range(3)]
    weight = torch.randn(shape)
    mask = graph.allowed()
    layer = MeshAttention(width, options.heads)
    tokens = torch.randn(options.batch, graph.n_tokens, width, requires_grad=True)
    projected = torch.randn(options.batch, graph.n_tokens, 3 * width)

    def dense(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        query, key, value = (tensor.transpose(1, 2) for tensor in (query, key, value))
        attend = torch.nn.functional.scaled_dot_product_attention
        return attend(query, key, value, attn_mask=mask).transpose(1, 2)

    def both(forward: Callable[[], Tensor], leaves: list[Tensor], gradient: Tensor) -> Callable[[], object]:
        return lambda: torch.autograd.grad(forward(), leaves, gradient)

    ways: dict[str, Callable[[], Tensor]] = {
        "dense": lambda: dense(inputs[0], inputs[1], inputs[2]),
        "reference": lambda: mesh_attention(inputs[0], inputs[1], inputs[2], graph, backend="reference"),
        "native": lambda: mesh_attention(inputs[0], inputs[1], inputs[2], graph, backend="native"),
    }
    runs: dict[tuple[str, str], Callable[[], object]] = {}
    for name, way in ways.items():
        runs[name, "forward"] = torch.no_grad()(way)
        runs[name, "forward + backward"] = both(way, inputs, weight)
    leaves = [tokens, layer.project_in.weight, layer.project_in.bias]
    runs["QKV projection", "forward"] = torch.no_grad()(lambda: layer.project_in(tokens))
    runs["QKV projection", "forward + backward"] = both(lambda: layer.project_in(tokens), leaves, projected)
    case = f"{options.vertices:,} vertices"
    medians = _medians(runs, options.repeats)
    for (name, metric), milliseconds in medians.items():
        results.add(case, name, metric, milliseconds, "ms")
    for metric in ("forward", "forward + backward"):
        for name in ("dense", "reference", "QKV projection"):
            ratio = medians[name, metric] / medians["native", metric]
            results.add(case, f"{name} / native", metric + " ratio", ratio, "x")


def _scale(options: BenchmarkOptions, vertices: int, results: Results) -> None:
    graph = MeshGraph.from_faces(closed_mesh_faces(vertices), n_vertices=vertices)
    shape = (options.batch, graph.n_tokens, options.heads, options.dim)
    inputs = [torch.randn(shape, requires_grad=True) for _ in range(3)]
    weight = torch.randn(shape)

    def forward() -> Tensor:
        return mesh_attention(inputs[0], inputs[1], inputs[2], graph, backend="native")

    runs: dict[tuple[str, str], Callable[[], object]] = {
        ("native", "forward"): torch.no_grad()(forward),
        ("native", "forward + backward"): lambda: torch.autograd.grad(forward(), inputs, weight),
    }
    for (name, metric), milliseconds in _medians(runs, options.repeats).items():
        nanoseconds = 1e6 * milliseconds / (options.batch * vertices)
        results.add(f"{vertices:,} vertices", name, metric + " a vertex", nanoseconds, "ns")


def _medians(runs: dict[tuple[str, str], Callable[[], object]], repeats: int) -> dict[tuple[str, str], float]:
    times: dict[tuple[str, str], list[float]] = {name: [] for name in runs}
    for repeat in range(repeats + 1):
        for name, function in runs.items():
            start = time.perf_counter()
            function()
            if repeat:  # the first round warms up
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}


def _peak_memory(options: BenchmarkOptions, vertices: int) -> float:
    graph = MeshGraph.from_faces(closed_mesh_faces(vertices), n_vertices=vertices)
    width = options.heads * options.dim
    layer = MeshAttention(width, options.heads)
    optimizer = torch.optim.Adam(layer.parameters())
    tokens = torch.randn(options.batch, graph.n_tokens, width, requires_grad=True)
    for _ in range(2):
        layer(tokens, graph).square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
