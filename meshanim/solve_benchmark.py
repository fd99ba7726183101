"""How long the blendshape solve of a frame takes, in batch and one by one, beside scipy's solver."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Float32, Int
from scipy.optimize import lsq_linear

from meshanim.animator import Animator
from meshanim.geometry import carry, subdivide
from meshanim.heads import DefaultHead, Head, Rig, load_head, rig_head
from meshanim.heads.default.head import SEAL_NAME
from meshanim.motion.blendshape_solver import BlendshapeSolver
from meshanim.results import Results

__all__ = ["SolveBenchmark", "run"]

Frames = Float32[np.ndarray, "frames vertices 3"]


@dataclass(frozen=True)
class SolveBenchmark:
    """Time of the blendshape solve a frame on one core, with everything from vertices to weights in it.

    Example: meshanim bench solve --json solve.json
    """

    samples: int = 5000
    """Vertices of the finer head that the solve looks at."""
    frames: int = 182
    """Frames a case, at most those of the sentence."""
    scipy_frames: int = 8
    """Frames that scipy solves."""
    repeats: int = 9
    """Interleaved repeats: medians by the clock, and the least time of the processor, which other programs
    disturb less. scipy on all vertices runs once."""
    seed: int = 0
    json: Path | None = None
    """Also write the rows here."""


def run(options: SolveBenchmark, clip: Path) -> Results:
    """Measure on the default head with ARKit's 52 shapes, and on the same head with four times the triangles.

    Parameters
    ----------
    options : SolveBenchmark
    clip : Path
        The sound that the animated head speaks.
    """
    results = Results("solve")
    speech = Animator.from_pretrained("default")(clip).vertices[: options.frames]
    head = _arkit(load_head("default"))
    finer = subdivide(head.mesh, "midpoint")
    shapes = carry(finer.operator, _deltas(head))
    regions = {name: _finer(finer.operator, rows) for name, rows in head.regions.items()}
    fine_head = rig_head(
        Rig(finer.mesh.vertices, finer.mesh.faces, head.expression_names, shapes, regions=regions)
    )
    coarse = BlendshapeSolver.from_head(head)
    fine = BlendshapeSolver.from_head(fine_head, samples=options.samples)
    rng = np.random.default_rng(options.seed)
    wandering = np.cumsum(rng.normal(0, 0.06, (len(speech), 52)), 0) / 2 + rng.uniform(-0.5, 0.4, 52)
    noisy = fine.reconstruct(np.clip(wandering, 0, 1)) + rng.normal(
        0, 2e-4, (len(speech), *fine.neutral.shape)
    )
    cases = {
        "speech": (coarse, speech),
        "speech, finer head": (fine, carry(finer.operator, speech)),
        "random weights and noise, finer head": (fine, noisy.astype(np.float32)),
    }
    for name, (solver, frames) in cases.items():
        size = f"{len(solver.sampling.vertices):,} of {len(solver.neutral):,} vertices"
        _measure(f"{name}: {size}", solver, frames, options, results)
    return results


def _measure(
    case: str, solver: BlendshapeSolver, frames: Frames, options: SolveBenchmark, results: Results
) -> None:
    reference = BlendshapeSolver(
        solver.neutral, solver.deltas, solver.names, solver.options, solver.sampling, backend="reference"
    )
    part = frames[: options.scipy_frames]
    stacked = _stacked(solver)
    threads = torch.get_num_threads()

    def one_by_one() -> None:
        stream = solver.stream()
        for t in range(len(frames)):
            stream.push(frames[t : t + 1])

    ways: dict[str, tuple[Callable[[], object], int]] = {
        "batch": (lambda: solver(frames), len(frames)),
        "one frame at a time": (one_by_one, len(frames)),
        "scipy on the Gram matrix": (lambda: reference(part), len(part)),
        "scipy on all vertices": (lambda: _scipy(stacked, solver, part[-1]), 1),
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    busy: dict[str, list[float]] = {name: [] for name in ways}
    torch.set_num_threads(1)
    try:
        for repeat in range(options.repeats + 1):
            for name, (way, count) in ways.items():
                if name == "scipy on all vertices" and repeat != 1:
                    continue
                start, started = time.perf_counter(), time.thread_time()
                way()
                if repeat:  # the first round warms up
                    times[name].append(1e3 * (time.perf_counter() - start) / count)
                    busy[name].append(1e3 * (time.thread_time() - started) / count)
    finally:
        torch.set_num_threads(threads)
    least = {name: min(values) for name, values in busy.items()}
    for name, values in times.items():
        results.add(case, name, "a frame, median", statistics.median(values), "ms")
        results.add(case, name, "a frame, processor", least[name], "ms")
    for name in ("batch", "one frame at a time"):
        for other in ("scipy on the Gram matrix", "scipy on all vertices"):
            results.add(case, f"{other} / {name}", "ratio", least[other] / least[name], "x")
    exact = solver(part.astype(np.float64))
    results.add(
        case, "float64 - scipy", "largest difference", np.abs(exact - reference(part)).max(), "weight"
    )
    results.add(case, "float32 - float64", "largest difference", np.abs(solver(part) - exact).max(), "weight")
    error = np.linalg.norm(solver.reconstruct(solver(frames)) - frames, axis=2)[:, solver.sampling.vertices]
    results.add(case, "batch", "residual rms", 1e3 * float(np.sqrt(np.square(error).mean())), "mm")


def _arkit(head: DefaultHead) -> Head:
    names = [name for name in head.expression_names if name != SEAL_NAME]
    rows = [head.expression_names.index(name) for name in names]
    return rig_head(
        Rig(head.mesh.vertices, head.mesh.faces, tuple(names), _deltas(head)[rows], regions=head.regions)
    )


def _finer(operator: sp.csr_array, rows: np.ndarray) -> Int[np.ndarray, " vertices"]:
    inside = np.zeros(operator.shape[1])
    inside[rows] = 1
    return np.flatnonzero(operator @ inside >= 0.5)


def _deltas(head: Head) -> Float[np.ndarray, "shapes vertices 3"]:
    return head.expression_directions.unflatten(1, (-1, 3)).numpy().astype(np.float64)


def _stacked(solver: BlendshapeSolver) -> Float[np.ndarray, "rows shapes"]:
    """All terms as rows of one least squares problem."""
    at, n = solver.sampling.vertices, len(solver.names)
    root = np.sqrt(solver.sampling.weights / solver.sampling.weights.sum())[:, None] / solver.unit
    data = (root * solver.deltas[:, at]).reshape(n, -1).T
    ridge = np.sqrt(solver.options.l2) * np.eye(n)
    return np.concatenate([data, ridge, np.full((1, n), np.sqrt(solver.options.l1))])


def _scipy(stacked: np.ndarray, solver: BlendshapeSolver, frame: Float[np.ndarray, "vertices 3"]) -> None:
    at = solver.sampling.vertices
    root = np.sqrt(solver.sampling.weights / solver.sampling.weights.sum())[:, None] / solver.unit
    goal = np.zeros(len(stacked))
    goal[: 3 * len(at)] = (root * (frame[at] - solver.neutral[at])).ravel()
    lsq_linear(stacked, goal, (0, 1), method="bvls")
