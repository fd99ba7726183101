"""Alignment: recovers what moved the points, is optimal, never reflects, differentiates."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import rotations

from meshanim.errors import ShapeError
from meshanim.geometry import Similarity, align


def points(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), rotations(), st.floats(0.01, 100), st.sampled_from([1e-3, 1.0, 1e3]))
def test_recovers_a_similarity_at_any_size(seed, rotation, scale, size):
    source = size * points(seed, 7)
    truth = Similarity(torch.from_numpy(rotation), size * points(seed + 1), torch.tensor(scale).double())
    found = align(source, truth.apply(source), scaling=True)
    torch.testing.assert_close(found.rotation, truth.rotation, atol=1e-7, rtol=0)
    torch.testing.assert_close(found.scale, truth.scale)
    torch.testing.assert_close(found.apply(source), truth.apply(source))
    torch.testing.assert_close(found.inverse().apply(found.apply(source)), source)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.booleans())
def test_no_small_change_is_better(seed, scaling):
    random = np.random.default_rng(seed)
    source, target = points(seed, 9), points(seed + 1, 9)
    weights = torch.from_numpy(random.uniform(0, 1, 9))
    best = align(source, target, weights, scaling)

    def cost(similarity: Similarity) -> float:
        return float((weights * (similarity.apply(source) - target).square().sum(-1)).sum())

    for _ in range(20):
        twist = torch.from_numpy(0.05 * random.standard_normal(3))
        skew = torch.tensor([[0, -twist[2], twist[1]], [twist[2], 0, -twist[0]], [-twist[1], twist[0], 0]])
        nudged = Similarity(
            torch.linalg.matrix_exp(skew) @ best.rotation,
            best.translation + torch.from_numpy(0.05 * random.standard_normal(3)),
            best.scale * (1 + 0.05 * random.standard_normal() * scaling),
        )
        assert cost(nudged) >= cost(best) - 1e-9


def test_mirrored_points_get_a_rotation():
    source = points(0, 10)
    found = align(source, source * torch.tensor([-1.0, 1, 1]))
    assert torch.linalg.det(found.rotation) == pytest.approx(1)
    assert found.scale == 1


def test_batches_and_zero_weights():
    source = points(0, 4, 8)
    target = points(1, 4, 8)
    weights = torch.rand(4, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    weights[:, 5] = 0
    whole = align(source, target, weights, scaling=True)
    keep = [0, 1, 2, 3, 4, 6, 7]
    for i in range(4):
        part = align(source[i, keep], target[i, keep], weights[i, keep], scaling=True)
        for a, b in zip(whole, part):
            torch.testing.assert_close(a[i], b)


def test_gradients():
    source, target = points(3, 6).requires_grad_(), points(4, 6)
    weights = torch.linspace(0.1, 1, 6, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, w: tuple(align(s, target, w, scaling=True)), (source, weights))


def test_refusals():
    with pytest.raises(ShapeError, match="three points"):
        align(points(0, 2), points(1, 2))
    with pytest.raises(ShapeError, match="coincide"):
        align(torch.ones(5, 3), torch.ones(5, 3))
    with pytest.raises(ShapeError, match="NaN"):
        align(torch.full((5, 3), float("nan")), torch.ones(5, 3))
    with pytest.raises(ShapeError, match="not all zero"):
        align(points(0, 5), points(1, 5), torch.zeros(5, dtype=torch.float64))
