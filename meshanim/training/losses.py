"""Losses of animated meshes. Distances are in millimetres, so that the published weights have a scale."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, distributed

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
    mask: Bool[Tensor, "*batch"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared distance of corresponding vertices, mm^2 (GAVA, L_r).

    The text of Sec. III-E says mean squared error, Eq. 4 prints a norm; the text is followed.

    Parameters
    ----------
    predicted, true : (..., V, 3)
        Metres.
    vertex_weights : (V,), optional
        Non-negative weights; normalised to a mean of one. All ones (the paper) if not given.
    mask : (sequences, frames) bool, optional
        Frames that count: the mean is over the frames of each sequence, then over the sequences.
    """
    squared = ((predicted - true) * MILLIMETRES).square().sum(-1)
    if vertex_weights is not None:
        squared = squared * (vertex_weights / vertex_weights.mean())
    return _mean_of_frames(squared.mean(-1), mask)


def _mean_of_frames(values: Float[Tensor, "*batch"], mask: Bool[Tensor, "*batch"] | None) -> Tensor:
    if mask is None:
        return values.mean()
    return ((values * mask).sum(-1) / mask.sum(-1)).mean()


def velocity_loss(
    predicted: Float[Tensor, "windows frames vertices 3"],
    true: Float[Tensor, "windows frames vertices 3"],
    vertex_weights: Float[Tensor, " vertices"] | None = None,
    mask: Bool[Tensor, "windows frames"] | None = None,
) -> Float[Tensor, ""]:
    """`reconstruction_loss` of the differences of consecutive frames, mm^2 (GAVA, Eq. 5).

    With a mask, of those whose two frames count.

    Raises
    ------
    ShapeError
        If a window has a single frame.
    """
    if predicted.shape[1] < 2:
        raise ShapeError("velocity_loss needs windows of at least two consecutive frames, not one")
    both = None if mask is None else mask[:, 1:] & mask[:, :-1]
    return reconstruction_loss(predicted.diff(dim=1), true.diff(dim=1), vertex_weights, both)


def eye_loss(
    predicted: Float[Tensor, "*batch vertices 3"],
    true: Float[Tensor, "*batch vertices 3"],
    eyes: Int[Tensor, " eyes"],
    floor: float = 1e-4,
    mask: Bool[Tensor, "*batch"] | None = None,
    everywhere: bool = False,
) -> Float[Tensor, ""]:
    """KL divergence of predicted from true eye-region movement as random variables (GAVA, Eq. 6).

    Each coordinate of each eye vertex is a normal distribution fitted over every frame of the batch,
    windows pooled; with a mask, over the frames of each sequence. The divergence of two normals in closed
    form is averaged over coordinates, and sequences.

    Parameters
    ----------
    predicted, true : (..., V, 3)
        Displacements from the subject's template in metres: every frame of the batch.
    eyes : (E,) int
        Vertices of the eye region.
    floor : float
        Smallest standard deviation in metres: a coordinate that rests in a batch has no spread of its own.
    mask : (sequences, frames) bool, optional
        Which frames count, with whole sequences.
    everywhere : bool
        Without a mask, pool the frames of all processes of a distributed run, which all call this with as
        many frames.

    Raises
    ------
    ShapeError
        If there are fewer than two frames.
    """
    if predicted[..., 0, 0].numel() < 2:
        raise ShapeError("eye_loss fits distributions over frames: give at least two")
    smallest = (floor * MILLIMETRES) ** 2
    both = torch.stack([predicted[..., eyes, :], true[..., eyes, :]]) * MILLIMETRES
    if mask is None:
        mean, variance = _moments(both.flatten(1, -3), everywhere)
    else:
        weight = (mask / mask.sum(1, keepdim=True))[None, :, :, None, None]
        mean = (both * weight).sum(2)
        variance = ((both - mean[:, :, None]).square() * weight).sum(2)
    mean_p, mean_t = mean
    variance_p, variance_t = variance + smallest
    divergence = 0.5 * (
        (variance_t / variance_p).log() + (variance_p + (mean_p - mean_t).square()) / variance_t - 1
    )
    return divergence.mean()


def _moments(
    values: Float[Tensor, "sides frames eyes 3"], everywhere: bool
) -> tuple[Float[Tensor, "sides eyes 3"], Float[Tensor, "sides eyes 3"]]:
    """Mean and variance over frames, those of all processes if wanted."""
    if not (everywhere and distributed.is_initialized() and distributed.get_world_size() > 1):
        return values.mean(1), values.var(1, correction=0)
    mean = _MeanOfProcesses.apply(values.mean(1))
    return mean, _MeanOfProcesses.apply((values - mean[:, None]).square().mean(1))


class _MeanOfProcesses(torch.autograd.Function):
    """The mean of a tensor over all processes; its gradient sums what all of them make of the mean."""

    @staticmethod
    def forward(context, values: Tensor) -> Tensor:
        return _summed(values) / distributed.get_world_size()

    @staticmethod
    def backward(context, gradient: Tensor) -> Tensor:
        return _summed(gradient) / distributed.get_world_size()


def _summed(values: Tensor) -> Tensor:
    values = values.contiguous().clone()
    distributed.all_reduce(values)
    return values


def pose_loss(
    predicted: Float[Tensor, "*batch 3"],
    true: Float[Tensor, "*batch 3"],
    mask: Bool[Tensor, "*batch"] | None = None,
) -> Float[Tensor, ""]:
    """Mean distance of true and predicted head rotation vectors, radians (GAVA, Eq. 7).

    The gradient where both agree exactly is zero, not undefined.
    """
    return _mean_of_frames(torch.linalg.vector_norm(predicted - true, dim=-1), mask)
