"""Rigid and similarity alignment of corresponding points."""

from typing import NamedTuple

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import ShapeError

__all__ = ["Similarity", "align"]


class Similarity(NamedTuple):
    """The map x -> scale * rotation @ x + translation."""

    rotation: Float[Tensor, "*batch 3 3"]
    translation: Float[Tensor, "*batch 3"]
    scale: Float[Tensor, "*batch"]

    def apply(self, points: Float[Tensor, "*batch points 3"]) -> Float[Tensor, "*batch points 3"]:
        """Map points; batch dimensions broadcast."""
        turned = points @ (self.scale[..., None, None] * self.rotation).mT
        return turned + self.translation[..., None, :]

    def inverse(self) -> "Similarity":
        back = self.rotation.mT
        scale = 1 / self.scale
        translation = -scale[..., None] * (back @ self.translation[..., None])[..., 0]
        return Similarity(back, translation, scale)


def align(
    source: Float[Tensor, "*batch points 3"],
    target: Float[Tensor, "*batch points 3"],
    weights: Float[Tensor, "*batch points"] | None = None,
    scaling: bool = False,
) -> Similarity:
    """Find the rigid motion or similarity that brings points closest to their partners.

    Minimises sum_i w_i |s R x_i + t - y_i|² over rotations R (never reflections), translations t and, if
    asked, scales s (Umeyama 1991, solved by roma). Differentiable in points and weights.

    Parameters
    ----------
    source, target : (..., N, 3) float
        Corresponding points in metres.
    weights : (..., N) float, optional
        Not negative, their sum positive; one each by default.
    scaling : bool
        Whether to find a scale too; else it is one.

    Raises
    ------
    ShapeError
        If there are fewer than three points, the points or weights of a set are not finite, weights are
        negative or all zero, or all points of a set coincide.
    """
    if source.shape[-2] < 3:
        raise ShapeError(f"alignment needs three points or more, got {source.shape[-2]}")
    if weights is None:
        weights = torch.ones_like(source[..., 0])
    total = weights.sum(-1, keepdim=True)
    if not (torch.isfinite(total).all() and (weights >= 0).all() and (total > 0).all()):
        raise ShapeError("weights must be finite and not negative, and not all zero")
    share = (weights / total)[..., None]
    source_centre, target_centre = (share * source).sum(-2), (share * target).sum(-2)
    source_size = _spread(source, source_centre, share, "source")
    target_size = _spread(target, target_centre, share, "target")
    # Both sets at unit size: roma's guard against ambiguous rotations is absolute.
    rotation, _, relative = roma.rigid_points_registration(
        (source - source_centre[..., None, :]) / source_size[..., None, None],
        (target - target_centre[..., None, :]) / target_size[..., None, None],
        weights=share[..., 0],
        compute_scaling=True,
    )
    scale = relative * target_size / source_size if scaling else torch.ones_like(source_size)
    moved = scale[..., None] * (rotation @ source_centre[..., None])[..., 0]
    return Similarity(rotation, target_centre - moved, scale)


def _spread(points: Tensor, centre: Tensor, share: Tensor, name: str) -> Tensor:
    square = (share * (points - centre[..., None, :]) ** 2).sum((-2, -1))
    if not torch.isfinite(square).all():
        raise ShapeError(f"{name}: some points are NaN or infinite")
    if not (square > 0).all():
        raise ShapeError(f"{name}: all points with weight coincide, so no rotation is best")
    return square.sqrt()
