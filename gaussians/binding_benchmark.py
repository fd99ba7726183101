"""How fast Gaussians follow a mesh: the compiled binding against torch."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from meshanim.gaussians.binding import bind
from meshanim.gaussians.gaussians import Gaussians
from meshanim.geometry import TriangleMesh
from meshanim.results import Results

__all__ = ["BindingBenchmark", "run"]


@dataclass(frozen=True)
class BindingBenchmark:
    """Time to take Gaussians on triangles to the world, native against torch.

    Example: meshanim bench binding --json binding.json
    """

    faces: int = 10_000
    """Triangles of a sphere, about."""
    per_face: int = 6
    """Gaussians a triangle."""
    frames: tuple[int, ...] = (1, 8)
    """Poses at once."""
    repeats: int = 15
    """Interleaved repeats; medians are reported."""
    json: Path | None = None
    """Also write the rows here."""


def run(options: BindingBenchmark | None = None) -> Results:
    """Measure and return the rows; milliseconds are medians of interleaved repeats."""
    options = options or BindingBenchmark()
    results = Results("binding")
    rings = max(3, round((options.faces / 4) ** 0.5))
    import trimesh  # slow to load, and few need it

    made = trimesh.creation.uv_sphere(0.1, count=[rings, rings])
    mesh = TriangleMesh(np.array(made.vertices), np.array(made.faces))
    binding = bind(mesh, options.per_face)
    local = binding.initial_gaussians().map(lambda field: field.requires_grad_())
    for frames in options.frames:
        generator = torch.Generator().manual_seed(frames)
        noise = torch.randn(frames, mesh.n_vertices, 3, generator=generator)
        vertices = (binding.rest.float() + 2e-4 * noise).requires_grad_()
        runs: dict[tuple[str, str], Callable[[], object]] = {}
        for backend in ("native", "reference"):

            def forward(backend: str = backend, vertices: torch.Tensor = vertices) -> Gaussians:
                return binding.to_world(local, vertices, backend=backend)

            runs[backend, "forward"] = torch.no_grad()(forward)
            for metric, leaves in (
                ("forward + backward", [local.means, local.quaternions, local.scales]),
                ("the same with vertices", [local.means, local.quaternions, local.scales, vertices]),
            ):
                runs[backend, metric] = _both(forward, leaves)
        medians = _medians(runs, options.repeats)
        case = f"{len(binding):,} Gaussians on {mesh.n_faces:,} triangles, {frames} frames"
        for (name, metric), milliseconds in medians.items():
            results.add(case, name, metric, milliseconds, "ms")
        for metric in dict.fromkeys(metric for _, metric in runs):
            ratio = medians["reference", metric] / medians["native", metric]
            results.add(case, "reference / native", metric + " ratio", ratio, "x")
    return results


def _both(forward: Callable[[], Gaussians], leaves: list[torch.Tensor]) -> Callable[[], object]:
    world = forward()
    weights = [torch.ones_like(part) for part in (world.means, world.quaternions, world.scales)]

    def run() -> object:
        world = forward()
        return torch.autograd.grad([world.means, world.quaternions, world.scales], leaves, weights)

    return run


def _medians(runs: dict[tuple[str, str], Callable[[], object]], repeats: int) -> dict[tuple[str, str], float]:
    times: dict[tuple[str, str], list[float]] = {name: [] for name in runs}
    for repeat in range(repeats + 1):
        for name, function in runs.items():
            start = time.perf_counter()
            function()
            if repeat:  # the first round warms up
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}
