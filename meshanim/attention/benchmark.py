"""How fast mesh attention is, against dense attention and the layer's own projection."""

import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from meshanim.attention.functional import mesh_attention
from meshanim.attention.graph import MeshGraph
from meshanim.attention.module import MeshAttention
from meshanim.errors import BackendError
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
    device: Literal["cpu", "cuda"] = "cpu"
    """cuda compares dense, the gathering form and the projection on an NVIDIA GPU, with its memory."""
    seed: int = 0
    json: Path | None = None
    """Also write the rows here."""


class Milliseconds(NamedTuple):
    """Medians: passed on the clock, and spent by all threads of this process together."""

    clock: float
    processor: float


def run(options: BenchmarkOptions | None = None) -> Results:
    """Measure and return the rows; milliseconds are medians of interleaved repeats.

    A cost a vertex comes twice: on the clock, and as processor time, which other programs on the machine
    disturb less. `traffic` counts the bytes that have to move at least once, per second of the clock; its
    share of what plain copying moves says how much of the memory's speed is used once a batch no longer fits
    the caches, and is above one while it does.

    Raises
    ------
    BackendError
        If device is "cuda" and there is no GPU.
    """
    options = options or BenchmarkOptions()
    if options.device == "cuda" and not torch.cuda.is_available():
        raise BackendError("torch finds no NVIDIA GPU: install a CUDA build of torch, or use --device cpu")
    results = Results("attention")
    torch.manual_seed(options.seed)
    _compare(options, results)
    copied = _copied(options)
    results.add("memory", "copy", "traffic", copied, "GB/s")
    for vertices in options.scaling:
        _scale(options, f"{vertices:,} vertices", closed_mesh_faces(vertices), copied, results)
    if options.scaling:
        most = max(options.scaling)
        shuffled = np.random.default_rng(options.seed).permutation(most)[closed_mesh_faces(most)]
        _scale(options, f"{most:,} vertices, numbered at random", shuffled, copied, results)
    if options.memory_vertices:
        context = multiprocessing.get_context("spawn")
        with context.Pool(1) as pool:
            gigabytes = pool.apply(_peak_memory, (options, options.memory_vertices))
        case = f"{options.memory_vertices:,} vertices"
        results.add(case, _sparse(options), "training step peak memory", gigabytes, "GB")
    return results


def closed_mesh_faces(vertices: int) -> np.ndarray:
    """Triangles of a closed surface with exactly this many vertices, numbered by rings around an axis."""
    angle = np.pi * (3 - 5**0.5) * np.arange(vertices)
    height = 1 - 2 * (np.arange(vertices) + 0.5) / vertices
    radius = np.sqrt(1 - height**2)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)
    return ConvexHull(points).simplices.astype(np.int64)


def _sparse(options: BenchmarkOptions) -> str:
    return "native" if options.device == "cpu" else "cuda"


def _compare(options: BenchmarkOptions, results: Results) -> None:
    device, sparse = options.device, _sparse(options)
    graph = MeshGraph.from_faces(closed_mesh_faces(options.vertices), n_vertices=options.vertices).to(device)
    width = options.heads * options.dim
    shape = (options.batch, graph.n_tokens, options.heads, options.dim)
    inputs = [torch.randn(shape, device=device, requires_grad=True) for _ in range(3)]
    weight = torch.randn(shape, device=device)
    mask = graph.allowed()
    layer = MeshAttention(width, options.heads).to(device)
    tokens = torch.randn(options.batch, graph.n_tokens, width, device=device, requires_grad=True)
    projected = torch.randn(options.batch, graph.n_tokens, 3 * width, device=device)

    def dense(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        query, key, value = (tensor.transpose(1, 2) for tensor in (query, key, value))
        attend = torch.nn.functional.scaled_dot_product_attention
        return attend(query, key, value, attn_mask=mask).transpose(1, 2)

    def both(forward: Callable[[], Tensor], leaves: list[Tensor], gradient: Tensor) -> Callable[[], object]:
        return lambda: torch.autograd.grad(forward(), leaves, gradient)

    def by(backend: str) -> Callable[[], Tensor]:
        return lambda: mesh_attention(inputs[0], inputs[1], inputs[2], graph, backend=backend)

    ways: dict[str, Callable[[], Tensor]] = {"dense": lambda: dense(inputs[0], inputs[1], inputs[2])}
    if device == "cpu":
        ways["reference"] = by("reference")
    ways[sparse] = by(sparse)
    runs: dict[tuple[str, str], Callable[[], object]] = {}
    for name, way in ways.items():
        runs[name, "forward"] = torch.no_grad()(way)
        runs[name, "forward + backward"] = both(way, inputs, weight)
    leaves = [tokens, layer.project_in.weight, layer.project_in.bias]
    runs["QKV projection", "forward"] = torch.no_grad()(lambda: layer.project_in(tokens))
    runs["QKV projection", "forward + backward"] = both(lambda: layer.project_in(tokens), leaves, projected)
    case = f"{options.vertices:,} vertices"
    medians = _medians(runs, options)
    for (name, metric), passed in medians.items():
        results.add(case, name, metric, passed.clock, "ms")
    for metric in ("forward", "forward + backward"):
        for name in (*(way for way in ways if way != sparse), "QKV projection"):
            ratio = medians[name, metric].clock / medians[sparse, metric].clock
            results.add(case, f"{name} / {sparse}", metric + " ratio", ratio, "x")


def _scale(options: BenchmarkOptions, case: str, faces: np.ndarray, copied: float, results: Results) -> None:
    device, sparse = options.device, _sparse(options)
    graph = MeshGraph.from_faces(faces).to(device)
    shape = (options.batch, graph.n_tokens, options.heads, options.dim)
    inputs = [torch.randn(shape, device=device, requires_grad=True) for _ in range(3)]
    weight = torch.randn(shape, device=device)

    def forward() -> Tensor:
        return mesh_attention(inputs[0], inputs[1], inputs[2], graph, backend=sparse)

    runs: dict[tuple[str, str], Callable[[], object]] = {
        (sparse, "forward"): torch.no_grad()(forward),
        (sparse, "forward + backward"): lambda: torch.autograd.grad(forward(), inputs, weight),
    }
    medians = _medians(runs, options)
    tokens = options.batch * graph.n_vertices
    for (name, metric), passed in medians.items():
        results.add(case, name, metric + " a vertex", 1e6 * passed.clock / tokens, "ns")
        if device == "cpu":
            results.add(
                case, name, metric + " processor time a vertex", 1e6 * passed.processor / tokens, "ns"
            )
    rate = _bytes(options, graph) / medians[sparse, "forward + backward"].clock / 1e6
    results.add(case, sparse, "traffic", rate, "GB/s")
    results.add(case, f"{sparse} / copy", "traffic share", rate / copied, "x")


def _bytes(options: BenchmarkOptions, graph: MeshGraph) -> float:
    """What a step has to read and write at least: each input of each pass once, each output once.

    Forward: query, key, value; the output and the probabilities. Backward: those three, the output's gradient
    and the probabilities; three gradients.
    """
    features = options.batch * graph.n_tokens * options.heads * options.dim
    edges = graph.n_edges + (graph.n_tokens if graph.global_token else 0)
    return 4.0 * (11 * features + 2 * options.batch * options.heads * edges)


def _copied(options: BenchmarkOptions, floats: int = 1 << 26) -> float:
    """GB/s read and written by copying a tensor larger than the caches."""
    source = torch.zeros(floats, device=options.device)
    target = torch.zeros_like(source)
    passed = _medians({("copy", ""): lambda: target.copy_(source)}, options)["copy", ""]
    return 8e-6 * floats / passed.clock


def _medians(
    runs: dict[tuple[str, str], Callable[[], object]], options: BenchmarkOptions
) -> dict[tuple[str, str], Milliseconds]:
    times: dict[tuple[str, str], list[Milliseconds]] = {name: [] for name in runs}
    for repeat in range(options.repeats + 1):
        for name, function in runs.items():
            clock, processor = time.perf_counter(), time.process_time()
            function()
            if options.device == "cuda":
                torch.cuda.synchronize()
            if repeat:  # the first round warms up
                passed, spent = time.perf_counter() - clock, time.process_time() - processor
                times[name].append(Milliseconds(1e3 * passed, 1e3 * spent))
    return {
        name: Milliseconds(*(statistics.median(column) for column in zip(*values, strict=True)))
        for name, values in times.items()
    }


def _peak_memory(options: BenchmarkOptions, vertices: int) -> float:
    device = options.device
    graph = MeshGraph.from_faces(closed_mesh_faces(vertices), n_vertices=vertices).to(device)
    width = options.heads * options.dim
    layer = MeshAttention(width, options.heads).to(device)
    optimizer = torch.optim.Adam(layer.parameters())
    tokens = torch.randn(options.batch, graph.n_tokens, width, device=device, requires_grad=True)
    for _ in range(2):
        layer(tokens, graph).square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()
    if device == "cuda":
        return torch.cuda.max_memory_allocated() / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
