"""Distance of two distributions of motion: the Frechet distance of Gaussians fitted to stated features."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from meshanim.errors import ShapeError
from meshanim.training.metrics.checks import check_finite, chosen

__all__ = ["Moments", "frechet_distance", "frechet_of_moments", "moments", "motion_features"]

LANDMARKS = 32
Features = Float[Tensor, "frames dim"]


class Moments(NamedTuple):
    """Sums from which mean and covariance follow; those of two sets of frames add up."""

    frames: Float[Tensor, ""]
    total: Float[Tensor, " dim"]
    outer: Float[Tensor, "dim dim"]


def motion_features(
    vertices: Float[Tensor, "frames vertices 3"],
    template: Float[Tensor, "vertices 3"],
    mask: Int[Tensor, " mask"],
    landmarks: int = LANDMARKS,
) -> Float[Tensor, "steps dim"]:
    """Displacement from the template and step to the next frame of vertices picked evenly from a mask.

    The steps make the distance see jitter, which leaves the distribution of displacements as it is.

    Parameters
    ----------
    vertices : (T, V, 3)
        At least two frames.
    template : (V, 3)
        The subject at rest: two people differ by how they move, not by their faces.
    mask : (M,) int
        In its own order, ceil(M / landmarks)-th entries are taken.
    landmarks : int
        Most vertices taken.

    Returns
    -------
    (T - 1, 6 K)
        Displacements, then steps, of the K vertices taken, in the unit of the vertices.
    """
    picked = mask[:: -(-len(mask) // landmarks)]
    moved = chosen(vertices, picked) - chosen(template[None], picked)
    if len(moved) < 2:
        raise ShapeError("one frame has no step to the next: at least two are needed")
    return torch.cat([moved[:-1].flatten(1), moved.diff(dim=0).flatten(1)], 1)


def moments(features: Features) -> Moments:
    """Number, sum and sum of outer products, in float64."""
    check_finite(features)
    values = features.double()
    return Moments(values.new_tensor(len(values)), values.sum(0), values.T @ values)


def frechet_of_moments(first: Moments, second: Moments) -> Float[Tensor, ""]:
    """`frechet_distance` of frames summed up in moments.

    Raises
    ------
    ShapeError
        If either has fewer than two frames or their features differ in number.
    """
    if first.total.shape != second.total.shape:
        raise ShapeError(f"{len(first.total)} and {len(second.total)} features cannot be compared")
    if min(float(first.frames), float(second.frames)) < 2:
        raise ShapeError("a Gaussian needs at least two frames on either side")
    (mean_a, root_a), (mean_b, root_b) = (_mean_and_root(m) for m in (first, second))
    # tr (A B)^(1/2) is the sum of the singular values of A^(1/2) B^(1/2).
    shared = torch.linalg.svdvals(root_a @ root_b).sum()
    spread = root_a.square().sum() + root_b.square().sum() - 2 * shared
    return (mean_a - mean_b).square().sum() + spread.clamp_min(0)


def frechet_distance(predicted: Features, true: Float[Tensor, "true_frames dim"]) -> Float[Tensor, ""]:
    """Frechet distance of the Gaussians fitted to two sets of features, in their unit squared.

    |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)), covariances divided by the count less one (Dowson and Landau
    1982, as in FID). No pairing of frames: it compares how much and where a face moves, not when.

    Parameters
    ----------
    predicted, true : (T, D), (T', D)
        Features of frames, such as `motion_features`.

    Raises
    ------
    ShapeError
        If either has fewer than two frames or holds NaN, or their features differ in number.
    """
    return frechet_of_moments(moments(predicted), moments(true))


def _mean_and_root(sums: Moments) -> tuple[Float[Tensor, " dim"], Float[Tensor, "dim dim"]]:
    mean = sums.total / sums.frames
    covariance = (sums.outer - torch.outer(mean, mean) * sums.frames) / (sums.frames - 1)
    values, vectors = torch.linalg.eigh(covariance)
    return mean, (vectors * values.clamp_min(0).sqrt()) @ vectors.T
