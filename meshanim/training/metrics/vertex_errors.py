"""Errors of corresponding vertices: lip, eye and mean vertex error, and those of several samples.

All functions take one sequence and give a number in the unit of its vertices (squared where said), so that
nothing is converted twice; `meshanim.training.metrics.modules` pools sequences and names units.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import ShapeError
from meshanim.training.metrics.checks import checked_pair

__all__ = [
    "coverage_error",
    "diversity",
    "eye_vertex_error",
    "largest_vertex_errors",
    "lip_vertex_error",
    "mean_estimate_error",
    "mean_vertex_error",
]

Vertices = Float[Tensor, "frames vertices 3"]
TrueVertices = Float[Tensor, "true_frames vertices 3"]
Samples = Float[Tensor, "samples frames vertices 3"]
Indices = Int[Tensor, " mask"]
Scalar = Float[Tensor, ""]


def largest_vertex_errors(
    predicted: Vertices,
    true: TrueVertices,
    mask: Indices,
    *,
    squared: bool = False,
) -> Float[Tensor, " frames"]:
    """Of each frame, the largest distance of a masked vertex from where it should be.

    Parameters
    ----------
    predicted, true : (T, V, 3)
        The same unit, pose and length.
    mask : (M,) int
        Vertices.
    squared : bool
        Squared distances.

    Raises
    ------
    ShapeError
        If the arrays differ in shape, are empty, or hold NaN within the mask.
    """
    predicted, true = checked_pair(predicted, true, mask)
    worst = (predicted - true).square().sum(-1).amax(1)
    return worst if squared else worst.sqrt()


def lip_vertex_error(
    predicted: Vertices,
    true: TrueVertices,
    lips: Indices,
    *,
    squared: bool = False,
) -> Scalar:
    """Mean over frames of the largest error of a lip vertex.

    The plain form is GAVA's E_vl (Eq. 8) and UniTalker's LVD; the squared form is the LVE of FaceFormer,
    CodeTalker, SelfTalk, DiffSpeaker, FaceDiffuser and UniTalker.

    Parameters
    ----------
    predicted, true : (T, V, 3)
        The same unit, pose and length.
    lips : (L,) int
        Lip vertices; published tables use different ones.
    squared : bool
        Squared distances, unit^2.

    Raises
    ------
    ShapeError
        As `largest_vertex_errors`.
    """
    return largest_vertex_errors(predicted, true, lips, squared=squared).mean()


def eye_vertex_error(
    predicted: Vertices,
    true: TrueVertices,
    eyes: Indices,
    *,
    squared: bool = False,
) -> Scalar:
    """`lip_vertex_error` on the eye region (GAVA, Sec. IV-A, E_ve)."""
    return lip_vertex_error(predicted, true, eyes, squared=squared)


def mean_vertex_error(predicted: Vertices, true: TrueVertices, mask: Indices | None = None) -> Scalar:
    """MVE: mean distance over frames and vertices, of all vertices without a mask (FaceDiffuser, Sec. 5)."""
    predicted, true = checked_pair(predicted, true, mask)
    return (predicted - true).norm(dim=-1).mean()


def mean_estimate_error(
    samples: Samples, true: TrueVertices, lips: Indices, *, squared: bool = True
) -> Scalar:
    """MEE: lip vertex error of the mean of all samples, not the mean of their errors (ProbTalk3D, Sec. 5).

    Parameters
    ----------
    samples : (S, T, V, 3)
        Predictions of one sequence; the paper draws 10.
    true : (T, V, 3)
        The recording.
    lips : (L,) int
        Lip vertices.
    squared : bool
        Squared distances, as the paper's table.
    """
    _check_samples(samples, 1)
    return lip_vertex_error(samples.mean(0), true, lips, squared=squared)


def coverage_error(samples: Samples, true: TrueVertices, lips: Indices, *, squared: bool = True) -> Scalar:
    """CE: lip vertex error of a sequence's best sample (ProbTalk3D, Sec. 5); see `mean_estimate_error`."""
    _check_samples(samples, 1)
    return torch.stack([lip_vertex_error(sample, true, lips, squared=squared) for sample in samples]).min()


def diversity(samples: Samples, mask: Indices | None = None) -> Scalar:
    """Mean distance of corresponding vertices over frames, vertices and all pairs of samples (FaceDiffuser).

    FaceDiffuser's samples are the predictions in different training subjects' styles. ProbTalk3D averages
    over five random pairs of ten, which has the same expectation.

    Parameters
    ----------
    samples : (S, T, V, 3)
        At least two predictions for one sound.
    mask : (M,) int, optional
        All vertices without it.

    Raises
    ------
    ShapeError
        If there are fewer than two samples.
    """
    _check_samples(samples, 2)
    pairs = [
        mean_vertex_error(samples[a], samples[b], mask)
        for a in range(len(samples))
        for b in range(a + 1, len(samples))
    ]
    return torch.stack(pairs).mean()


def _check_samples(samples: Samples, least: int) -> None:
    if len(samples) < least:
        raise ShapeError(f"{len(samples)} samples of a sequence: at least {least} are needed")
