"""Weights of a whole mesh sequence, and what they leave of its motion."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from meshanim.heads import Head, rig_head
from meshanim.motion.blendshape_csv import ARKIT_SHAPES
from meshanim.motion.blendshape_solver import BlendshapeSolver, SolverOptions
from meshanim.motion.blendshape_track import BlendshapeTrack
from meshanim.motion.personal_shapes import Method, personal_shapes
from meshanim.motion.sequence import MeshSequence
from meshanim.results import Results

__all__ = ["SolvedSequence", "arkit_only", "head_for", "solve_sequence"]

FRAMES_AT_ONCE = 256
USED = 0.01
REPORTED = ("face", "lips", "eyelids", "jaw")


@dataclass(frozen=True)
class SolvedSequence:
    """Weights, the motion they make on the sequence's own mesh, and how far it is from the sequence."""

    track: BlendshapeTrack
    motion: MeshSequence
    residual: Results
    """Root mean square and largest distance in mm by region, beside the size of the motion, and how many
    shapes are at work."""


def head_for(sequence: MeshSequence, head: Head, method: Method = "deformation_transfer") -> Head:
    """The head itself where the sequence has its triangles, else its shapes on the sequence's template."""
    mesh = sequence.mesh
    if head.mesh.n_vertices == mesh.n_vertices and np.array_equal(head.mesh.faces, mesh.faces):
        return head
    return rig_head(personal_shapes(head, mesh, method))


def arkit_only(options: SolverOptions, head: Head) -> SolverOptions:
    """The options with no other shapes active than ARKit's 52, for tables that have no column for others."""
    names = head.expression_names if options.active is None else options.active
    return replace(options, active=tuple(name for name in names if name in ARKIT_SHAPES))


def solve_sequence(
    sequence: MeshSequence,
    head: Head,
    options: SolverOptions | None = None,
    samples: int | None = None,
    progress: bool = False,
) -> SolvedSequence:
    """Solve every frame of a sequence, relative to its own template.

    Parameters
    ----------
    sequence : MeshSequence
    head : Head
        With the sequence's triangles: `head_for`.
    options : SolverOptions, optional
    samples : int, optional
        Vertices to look at, as in `sample_vertices`.
    progress : bool
        Whether to draw a progress bar.
    """
    solver = BlendshapeSolver.from_head(head, options, samples, sequence.mesh.vertices)
    stream, parts = solver.stream(), []
    frames = range(0, len(sequence), FRAMES_AT_ONCE)
    for start in tqdm(frames, desc="solve", unit="block", disable=not progress):
        parts.append(stream.push(sequence.vertices[start : start + FRAMES_AT_ONCE]))
    weights = np.concatenate(parts) if parts else np.zeros((0, len(solver.names)))
    track = BlendshapeTrack(solver.names, weights, sequence.fps, sequence.pose)
    made = solver.reconstruct(weights).astype(np.float32)
    motion = MeshSequence(made, sequence.fps, sequence.mesh, sequence.pose, sequence.audio)
    residual = _residual(sequence, made, head, solver)
    if len(weights):
        used = float((np.abs(weights) > USED).sum(1).mean())
        residual.add("weights", "blendshapes", f"shapes above {USED} a frame", used, "count")
    return SolvedSequence(track, motion, residual)


def _residual(
    sequence: MeshSequence, made: Float[np.ndarray, "frames vertices 3"], head: Head, solver: BlendshapeSolver
) -> Results:
    results = Results("solve")
    rest = 1000 * np.linalg.norm(made - sequence.vertices, axis=2)
    moved = 1000 * np.linalg.norm(sequence.vertices - sequence.mesh.vertices.astype(np.float32), axis=2)
    regions = {"sampled": solver.sampling.vertices, "all": np.arange(sequence.mesh.n_vertices)}
    regions |= {name: head.regions[name] for name in REPORTED}
    for name, rows in regions.items():
        if not len(rows) or not len(sequence):
            continue
        case = f"{name} ({len(rows)} vertices)"
        results.add(case, "blendshapes", "residual rms", _rms(rest[:, rows]), "mm")
        results.add(case, "blendshapes", "residual largest", float(rest[:, rows].max()), "mm")
        results.add(case, "blendshapes", "motion rms", _rms(moved[:, rows]), "mm")
    return results


def _rms(distances: np.ndarray) -> float:
    return float(np.sqrt(np.square(distances, dtype=np.float64).mean()))
