"""Spherical harmonics: Kerbl's order and signs, orthonormal, and rotated exactly."""

import numpy as np
import pytest
import scipy.special
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import OptionError, ShapeError
from meshanim.gaussians.harmonics import COEFFICIENTS, harmonics, rotate_harmonics


def random_rotations(seed: int, *batch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(*batch, 3, 3, dtype=torch.float64, generator=generator))
    q = q * torch.sign(torch.diagonal(r, dim1=-2, dim2=-1))[..., None, :]
    return q * torch.linalg.det(q)[..., None, None]


def random_directions(seed: int, count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    return torch.nn.functional.normalize(points, dim=-1)


def test_values_are_the_real_harmonics_with_the_signs_of_gaussian_splatting():
    directions = random_directions(0, 50)
    x, y, z = directions.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    values = harmonics(directions, 3).numpy()
    for degree in range(4):
        for order in range(-degree, degree + 1):
            whole = scipy.special.sph_harm_y(degree, abs(order), polar, azimuth)
            part = whole.imag if order < 0 else whole.real
            # scipy's Condon-Shortley phase is the sign that the splatting code writes out; of the negative
            # orders it takes the same.
            expected = part * (1 if order == 0 else np.sqrt(2))
            np.testing.assert_allclose(values[:, degree * degree + degree + order], expected, atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.integers(0, 3), st.integers(1, 4))
def test_the_rotated_function_has_the_old_values_in_turned_directions(seed, degree, channels):
    generator = torch.Generator().manual_seed(seed)
    coefficients = torch.randn(5, COEFFICIENTS[degree], channels, dtype=torch.float64, generator=generator)
    rotation, directions = random_rotations(seed, 5), random_directions(seed, 9)
    rotated = rotate_harmonics(coefficients, rotation)
    turned = directions @ rotation.mT  # R d
    torch.testing.assert_close(
        harmonics(turned, degree) @ rotated, harmonics(directions, degree) @ coefficients, atol=1e-12, rtol=0
    )
    torch.testing.assert_close(rotated.norm(dim=1), coefficients.norm(dim=1))


def test_single_precision_turns_within_rounding():
    coefficients, rotation = torch.randn(100, 16, 3), random_rotations(1, 100)
    exact = rotate_harmonics(coefficients.double(), rotation)
    assert (rotate_harmonics(coefficients, rotation.float()) - exact).abs().max() < 1e-5


def test_shared_coefficients_broadcast_over_frames():
    coefficients, rotation = torch.randn(6, 9, 3), random_rotations(2, 4, 6).float()
    rotated = rotate_harmonics(coefficients, rotation)
    assert rotated.shape == (4, 6, 9, 3)
    torch.testing.assert_close(rotated[3], rotate_harmonics(coefficients, rotation[3]))


def test_gradients_match_finite_differences():
    coefficients = torch.randn(2, 16, 3, dtype=torch.float64, requires_grad=True)
    rotation = random_rotations(3, 2).requires_grad_()
    assert torch.autograd.gradcheck(rotate_harmonics, (coefficients, rotation))


def test_other_numbers_are_named():
    with pytest.raises(OptionError, match="not 4"):
        harmonics(torch.zeros(3), 4)
    with pytest.raises(ShapeError, match="not 5"):
        rotate_harmonics(torch.zeros(2, 5, 3), torch.eye(3)[None])
