"""Real spherical harmonics of degree 0 to 3 in the order and with the signs of 3D Gaussian Splatting."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int
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
    coefficients: Float[Tensor, "*#batch n coefficients channels"],
    rotation: Float[Tensor, "*#batch rotations 3 3"],
    which: Int[Tensor, " n"] | None = None,
) -> Float[Tensor, "*batch n coefficients channels"]:
    """Coefficients of the rotated function: in direction R d it has the value that the old one has in d.

    Exact, as each degree is closed under rotation: the matrix of degree l maps the values of its 2 l + 1
    harmonics in fixed directions, turned back by R, to coefficients. Differentiable in both arguments.

    Parameters
    ----------
    coefficients : (..., N, K, C) float
        K = 1, 4, 9 or 16.
    rotation : (..., R, 3, 3) float
        Rotation matrices.
    which : (N,) int, optional
        The rotation that each takes; the one of its own index if not given.

    Raises
    ------
    ShapeError
        If K is another number.
    """
    count = coefficients.shape[-2]
    if count not in COEFFICIENTS:
        raise ShapeError(f"coefficients must be 1, 4, 9 or 16, not {count}")
    degree = COEFFICIENTS.index(count)
    batch = torch.broadcast_shapes(coefficients.shape[:-3], rotation.shape[:-3])
    rotated = [coefficients[..., :1, :].expand(*batch, -1, -1, -1)]
    for level in range(1, degree + 1):
        matrix = _rotation_of_degree(level, rotation)
        if which is not None:
            matrix = matrix.index_select(-3, which)
        part = coefficients[..., COEFFICIENTS[level - 1] : COEFFICIENTS[level], :]
        rotated.append((matrix[..., None] * part[..., None, :]).sum(-3))
    return torch.cat(rotated, -2)


def _rotation_of_degree(level: int, rotation: Tensor) -> Tensor:
    """(..., R, 2 l + 1, 2 l + 1): rows are old coefficients, columns new ones."""
    directions, to_coefficients = _samples(level)
    # Plain matrix products of many rows: batches of small ones are slow. Columns are R^T d.
    turned = (rotation.mT.reshape(-1, 3) @ directions.to(rotation).T).reshape(*rotation.shape[:-1], -1)
    values = harmonics(turned.mT, level)[..., COEFFICIENTS[level - 1] :].mT
    return values @ to_coefficients.to(rotation).T


@cache
def _samples(level: int) -> tuple[Tensor, Tensor]:
    """Directions over the sphere, and the matrix that fits the harmonics of one degree to values there."""
    index = np.arange(4 * level + 3)
    height = 1 - 2 * (index + 0.5) / len(index)
    angle, radius = np.pi * (3 - 5**0.5) * index, np.sqrt(1 - height**2)
    directions = torch.from_numpy(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1))
    values = harmonics(directions, level)[:, COEFFICIENTS[level - 1] :]
    return directions, torch.linalg.pinv(values)
