"""Real spherical harmonics of degree 0 to 3 in the order and with the signs of 3D Gaussian Splatting."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import OptionError, ShapeError

__all__ = ["COEFFICIENTS", "harmonics", "rotate_harmonics"]

COEFFICIENTS = (1, 4, 9, 16)
"""How many harmonics there are up to each degree."""


def harmonics(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch coefficients"]:
    """Values of all harmonics up to a degree.

    Parameters
    ----------
    directions : (..., 3) float
        Unit vectors; for colours, from the camera to the Gaussian.
    degree : int
        0 to 3.

    Returns
    -------
    (..., 1, 4, 9 or 16) float
        Colour is their products with the coefficients, summed, + 0.5 (Kerbl et al. 2023).

    Raises
    ------
    OptionError
        If the degree is not 0 to 3.
    """
    if degree not in range(len(COEFFICIENTS)):
        raise OptionError(f"degree must be 0, 1, 2 or 3, not {degree}")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        values += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(values, -1)


def rotate_harmonics(
    coefficients: Float[Tensor, "*#batch coefficients channels"], rotation: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch coefficients channels"]:
    """Coefficients of the rotated function: in direction R d it has the value that the old one has in d.

    Exact, as each degree is closed under rotation: the matrix of degree l maps the values of its 2 l + 1
    harmonics in fixed directions, turned back by R, to coefficients. Differentiable in both arguments.

    Parameters
    ----------
    coefficients : (..., K, C) float
        K = 1, 4, 9 or 16.
    rotation : (..., 3, 3) float
        Rotation matrices.

    Raises
    ------
    ShapeError
        If K is another number.
    """
    count = coefficients.shape[-2]
    if count not in COEFFICIENTS:
        raise ShapeError(f"coefficients must be 1, 4, 9 or 16, not {count}")
    degree = COEFFICIENTS.index(count)
    rotated = [coefficients[..., :1, :].expand(*_batch(coefficients, rotation), -1, -1)]
    for level in range(1, degree + 1):
        directions, to_coefficients = _samples(level)
        # Row vectors: d R is the direction R^T d.
        turned = directions.to(rotation) @ rotation
        start, end = COEFFICIENTS[level - 1], COEFFICIENTS[level]
        matrix = to_coefficients.to(rotation) @ harmonics(turned, level)[..., start:end]
        rotated.append(matrix @ coefficients[..., start:end, :])
    return torch.cat(rotated, -2)


def _batch(coefficients: Tensor, rotation: Tensor) -> torch.Size:
    return torch.broadcast_shapes(coefficients.shape[:-2], rotation.shape[:-2])


@cache
def _samples(level: int) -> tuple[Tensor, Tensor]:
    """Directions over the sphere, and the matrix that fits the harmonics of one degree to values there."""
    index = np.arange(4 * level + 3)
    height = 1 - 2 * (index + 0.5) / len(index)
    angle, radius = np.pi * (3 - 5**0.5) * index, np.sqrt(1 - height**2)
    directions = torch.from_numpy(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1))
    values = harmonics(directions, level)[:, COEFFICIENTS[level - 1] :]
    return directions, torch.linalg.pinv(values)
