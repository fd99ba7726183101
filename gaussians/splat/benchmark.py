"""How fast splatting is, against the torch reference and against what the processor could do."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor

from meshanim.attention.benchmark import closed_mesh_faces
from meshanim.gaussians.binding import bind
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.losses import image_loss
from meshanim.gaussians.splat.functional import rasterize
from meshanim.gaussians.splat.native import work
from meshanim.gaussians.splat.rendering import DepthMode
from meshanim.geometry import TriangleMesh
from meshanim.results import Results

__all__ = ["SplatBenchmark", "run", "training_step", "workload"]

# Floating-point operations a pixel and Gaussian, a fused multiply-add as two: exponent 10, exponential 9,
# light 3, colours 6; backward the first three again, colour behind 9, nine sums 18. The loops compiled for
# AVX-512 have 28 and 55: backward's nine sums are computed as twelve.
FORWARD, BACKWARD = 28, 49


@dataclass(frozen=True)
class SplatBenchmark:
    """Time of Gaussian splatting, against torch and the processor's peak, and of a whole training step.

    Example: meshanim bench splat --json splat.json
    """

    sizes: tuple[tuple[int, int], ...] = ((10_000, 256), (60_000, 512), (200_000, 1024))
    """Gaussians, and pixels a side of a square image."""
    reference: int = 10_000
    """Up to so many Gaussians the torch reference is timed too; 0: never."""
    repeats: int = 15
    """Interleaved repeats; medians are reported."""
    seed: int = 0
    json: Path | None = None
    """Also write the rows here."""


def run(options: SplatBenchmark | None = None) -> Results:
    """Measure and return the rows; milliseconds are medians of interleaved repeats."""
    options = options or SplatBenchmark()
    results = Results("splat")
    for count, size in options.sizes:
        _measure(options, count, size, results)
    return results


def workload(count: int, size: int, seed: int = 0) -> tuple[Gaussians, Cameras]:
    """A closed surface with a flat Gaussian on each of `count` triangles, in random order, and a view of it.

    Each pixel on it lies in about 40 Gaussians; opacities are 0.5 to 0.9.
    """
    generator = np.random.default_rng(seed)
    mesh = _surface(count, generator)
    corners = mesh.vertices[mesh.faces]
    along = corners[:, 1] - corners[:, 0]
    normals = np.cross(along, corners[:, 2] - corners[:, 0])
    edge = np.sqrt(np.median(np.linalg.norm(normals, axis=1)))
    axes = np.stack([along, np.cross(normals, along), normals], -1)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turn = np.zeros((count, 4))
    half = generator.uniform(0, np.pi, count) / 2
    turn[:, 2], turn[:, 3] = np.sin(half), np.cos(half)
    quaternions = roma.quat_product(roma.rotmat_to_unitquat(torch.from_numpy(axes)), torch.from_numpy(turn))
    spread = np.exp(generator.normal(size=(count, 3)) * [0.35, 0.35, 0.3])
    means = corners.mean(1) + axes[:, :, 2] * generator.normal(size=(count, 1)) * 0.1 * edge
    fields = {
        "means": means,
        "quaternions": quaternions.roll(1, -1).numpy(),
        "scales": spread * edge * [0.588, 0.336, 0.08],
        "opacities": generator.uniform(0.5, 0.9, count),
        "colors": 0.5 + 0.5 * np.sin(means * [3, 5, 7] + generator.normal(0, 0.3, (count, 3))),
    }
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    pose[2, 3] = 5.4
    k = torch.tensor([[2.2 * size, 0, size / 2], [0, 2.2 * size, size / 2], [0, 0, 1]])
    scene = Gaussians(**{name: torch.from_numpy(field).float() for name, field in fields.items()})
    return scene, Cameras(pose[None], k[None], size, size)


def _surface(count: int, generator: np.random.Generator) -> TriangleMesh:
    faces = generator.permutation(closed_mesh_faces(count // 2 + 2))[:count]
    n = faces.max() + 1
    angle = np.pi * (3 - 5**0.5) * np.arange(n)
    height = 1 - 2 * (np.arange(n) + 0.5) / n
    radius = np.sqrt(1 - height**2) * (1 + 0.04 * np.sin(5 * height) * np.cos(4 * angle))
    vertices = np.stack([0.78 * radius * np.cos(angle), height, 0.88 * radius * np.sin(angle)], 1)
    return TriangleMesh(vertices, faces)


def training_step(count: int, size: int, seed: int = 0) -> Callable[[], Tensor]:
    """A step that fits the workload, bound to its triangles and disturbed, to its own picture.

    Local Gaussians are activated, taken to the world by the posed mesh and rendered; the gradient of 0.8 L1 +
    0.2 D-SSIM moves means, scales, rotations, opacities and colours by Adam. Calling it returns the loss.
    """
    scene, cameras = workload(count, size, seed)
    with torch.no_grad():
        target = rasterize(scene, cameras, depth=None).rgb
    mesh = _surface(count, np.random.default_rng(seed))
    binding, vertices = bind(mesh), torch.from_numpy(mesh.vertices).float()
    local = binding.to_local(scene, vertices)
    assert scene.colors is not None
    start = local.means, local.scales.log(), local.quaternions, torch.logit(local.opacities), scene.colors
    generator = torch.Generator().manual_seed(seed)
    leaves = [
        (field + 0.05 * torch.randn(field.shape, generator=generator)).requires_grad_() for field in start
    ]
    optimizer = torch.optim.Adam(leaves, lr=1e-3, eps=1e-15, fused=True)

    def step() -> Tensor:
        means, scales, quaternions, opacities, colors = leaves
        bound = Gaussians(means, quaternions, scales.exp(), torch.sigmoid(opacities), colors)
        rendered = rasterize(binding.to_world(bound, vertices), cameras, depth=None).rgb
        loss = image_loss(rendered, target)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        return loss.detach()

    return step


def _measure(options: SplatBenchmark, count: int, size: int, results: Results) -> None:
    scene, cameras = workload(count, size, options.seed)
    leaves = scene.map(lambda field: field.clone().requires_grad_())
    assert leaves.colors is not None
    inputs = [leaves.means, leaves.quaternions, leaves.scales, leaves.opacities, leaves.colors]
    generator = torch.Generator().manual_seed(options.seed)
    towards = (
        torch.randn(1, size, size, 3, generator=generator),
        torch.randn(1, size, size, generator=generator),
    )

    def forward(backend: str, depth: DepthMode | None = None) -> Callable[[], object]:
        return torch.no_grad()(lambda: rasterize(scene, cameras, depth=depth, backend=backend))

    def both(backend: str) -> Callable[[], object]:
        def step() -> tuple[Tensor, ...]:
            out = rasterize(leaves, cameras, depth=None, backend=backend)
            return torch.autograd.grad((out.rgb, out.alpha), inputs, towards)

        return step

    runs = {
        ("native", "forward"): forward("native"),
        ("native", "forward with depth"): forward("native", depth="expected"),
        ("native", "forward + backward"): both("native"),
        ("native", "training step"): training_step(count, size, options.seed),
    }
    medians = _medians(runs, options.repeats)
    case = f"{count:,} Gaussians, {size} x {size}"
    if count <= options.reference:
        slow = {
            ("reference", "forward"): forward("reference"),
            ("reference", "forward + backward"): both("reference"),
        }
        medians |= _medians(slow, 3)
    for (name, metric), milliseconds in medians.items():
        results.add(case, name, metric, milliseconds, "ms")
    results.add(case, "native", "training steps", 1e3 / medians["native", "training step"], "1/s")
    for metric in ("forward", "forward + backward"):
        if ("reference", metric) in medians:
            ratio = medians["reference", metric] / medians["native", metric]
            results.add(case, "reference / native", metric + " ratio", ratio, "x")
    pairs = work(scene, cameras)
    peak = max(_peak() for _ in range(3))
    results.add(case, "native", "pairs of pixel and Gaussian", pairs, "1")
    results.add(case, "processor", "fused multiply-adds", peak / 1e9, "GFLOP/s")
    for metric, operations in (("forward", FORWARD), ("forward + backward", FORWARD + BACKWARD)):
        rate = pairs * operations / (medians["native", metric] / 1e3)
        results.add(case, "native", metric + " of peak", 100 * rate / peak, "%")


def _peak() -> float:
    """Operations a second that the kernels' instruction set reaches in registers, on torch's threads."""
    from meshanim import _native

    rounds = 4_000_000
    start = time.perf_counter()
    operations = _native.fused_multiply_adds(rounds, torch.get_num_threads())
    return operations / (time.perf_counter() - start)


def _medians(runs: dict[tuple[str, str], Callable[[], object]], repeats: int) -> dict[tuple[str, str], float]:
    times: dict[tuple[str, str], list[float]] = {name: [] for name in runs}
    for repeat in range(repeats + 1):
        for name, function in runs.items():
            start = time.perf_counter()
            function()
            if repeat:  # the first round warms up
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}
