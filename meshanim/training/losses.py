"""Losses of animated meshes. Distances are in millimetres, so that the published weights have a scale."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import ShapeError

__all__ = [
    "LossWeights",
    "eye_loss",
    "pose_loss",
    "reconstruction_loss",
    "velocity_loss",
]

MILLIMETRES = 1000.0


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of GAVA's loss, Eq. 3 and Sec. IV: L = L_r + 10 L_v + 0.001 L_p + 0.005 L_e.

    Parameters
    ----------
    reconstruction, velocity, pose, eyes : float
        Multipliers of L_r, L_v, L_p and L_e.
    """

    reconstruction: float = 1.0
    velocity: float = 10.0
    pose: float = 0.001
    eyes: float = 0.005


def reconstruction_loss(
    predicted: Float[Tensor, "*batch vertices 3"],
    true: Float[Tensor, "*batch vertices 3"],
    vertex_weights: Float[Tensor, " vertices"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared distance of corresponding vertices, mm^2 (GAVA, L_r).

    The text of Sec. III-E says mean squared error, Eq. 4 prints a norm; the text is followed.

    Parameters
    ----------
    predicted, true : (..., V, 3)
        Metres.
    vertex_weights : (V,), optional
        Non-negative weights; normalised to a mean of one. All ones (the paper) if not given.
    """
    squared = ((predicted - true) * MILLIMETRES).square().sum(-1)
    if vertex_weights is None:
        return squared.mean()
    return (squared * (vertex_weights / vertex_weights.mean())).mean()


def velocity_loss(
    predicted: Float[Tensor, "windows frames vertices 3"],
    true: Float[Tensor, "windows frames vertices 3"],
    vertex_weights: Float[Tensor, " vertices"] | None = None,
) -> Float[Tensor, ""]:
    """`reconstruction_loss` of the differences of consecutive frames, mm^2 (GAVA, Eq. 5).

    Raises
    ------
    ShapeError
        If a window has a single frame.
    """
    if predicted.shape[1] < 2:
        raise ShapeError("velocity_loss needs windows of at least two consecutive frames, not one")
    return reconstruction_loss(predicted.diff(dim=1), true.diff(dim=1), vertex_weights)


def eye_loss(
    predicted: Float[Tensor, "frames vertices 3"],
    true: Float[Tensor, "frames vertices 3"],
    eyes: Int[Tensor, " eyes"],
    floor: float = 1e-4,
) -> Float[Tensor, ""]:
    """KL divergence of predicted from true eye-region movement as random variables (GAVA, Eq. 6).

    Each coordinate of each eye vertex is a normal distribution fitted over every frame of the batch,
    windows pooled; the divergence of two normals in closed form is averaged over coordinates.

    Parameters
    ----------
    predicted, true : (T, V, 3)
        Displacements from the subject's template in metres: every frame of the batch.
    eyes : (E,) int
        Vertices of the eye region.
    floor : float
        Smallest standard deviation in metres: a coordinate that rests in a batch has no spread of its own.

    Raises
    ------
    ShapeError
        If there are fewer than two frames.
    """
    if predicted.shape[0] < 2:
        raise ShapeError("eye_loss fits distributions over frames: give at least two")
    predicted, true = predicted[:, eyes] * MILLIMETRES, true[:, eyes] * MILLIMETRES
    smallest = (floor * MILLIMETRES) ** 2
    mean_p, mean_t = predicted.mean(0), true.mean(0)
    variance_p = predicted.var(0, correction=0) + smallest
    variance_t = true.var(0, correction=0) + smallest
    divergence = 0.5 * (
        (variance_t / variance_p).log() + (variance_p + (mean_p - mean_t).square()) / variance_t - 1
    )
    return divergence.mean()


def pose_loss(predicted: Float[Tensor, "*batch 3"], true: Float[Tensor, "*batch 3"]) -> Float[Tensor, ""]:
    """Mean distance of true and predicted head rotation vectors, radians (GAVA, Eq. 7).

    The gradient where both agree exactly is zero, not undefined.
    """
    return torch.linalg.vector_norm(predicted - true, dim=-1).mean()
