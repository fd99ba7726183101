"""Triangle frames: rotations always, equivariant, GaussianAvatars' columns, finite when degenerate."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import rotations

from meshanim.geometry import triangle_frames

FACES = torch.tensor([[0, 1, 2], [2, 1, 3], [3, 0, 4]])


def random_vertices(seed: int, *batch: int, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*batch, 5, 3, dtype=torch.float64, generator=generator).to(dtype)


def assert_rotations(matrices: torch.Tensor, tolerance: float = 1e-10):
    eye = torch.eye(3, dtype=matrices.dtype).expand_as(matrices)
    torch.testing.assert_close(matrices.mT @ matrices, eye, atol=tolerance, rtol=0)
    torch.testing.assert_close(
        torch.linalg.det(matrices), torch.ones(matrices.shape[:-2]).to(eye), atol=tolerance, rtol=0
    )


def test_columns_scale_and_origin_of_a_known_triangle():
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [1, 3, 0]])
    rotation, scale, origin = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))
    # a0 = x, a1 = the normal z, a2 = a0 x a1 = -y, as in GaussianAvatars' code.
    assert rotation[0].tolist() == [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    assert scale.tolist() == [2.5]
    assert origin.tolist() == [[1, 1, 0]]


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), rotations(), st.floats(1e-3, 1e3))
def test_frames_follow_a_similarity(seed, rotation, size):
    vertices, turn = random_vertices(seed, 2), torch.from_numpy(rotation)
    offset = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    before = triangle_frames(vertices, FACES)
    after = triangle_frames(size * vertices @ turn.T + offset, FACES)
    assert_rotations(before.rotation)
    torch.testing.assert_close(after.rotation, turn @ before.rotation, atol=1e-6, rtol=0)
    torch.testing.assert_close(after.scale, size * before.scale)
    torch.testing.assert_close(after.origin, size * before.origin @ turn.T + offset)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_match_one_by_one(batch, dtype):
    vertices = random_vertices(1, *batch, dtype=dtype)
    frames = triangle_frames(vertices, FACES)
    assert frames.rotation.shape == (*batch, 3, 3, 3)
    assert frames.rotation.dtype == dtype
    for index in np.ndindex(*batch):
        single = triangle_frames(vertices[index], FACES)
        for whole, part in zip(frames, single):
            torch.testing.assert_close(whole[index], part)


def test_gradients_match_finite_differences():
    vertices = random_vertices(2, 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: tuple(triangle_frames(x, FACES)), vertices)


DEGENERATE = {
    "point": [[1.0, 2, 3]] * 3,
    "first side missing": [[1.0, 2, 3], [1, 2, 3], [0, 5, 1]],
    "second side missing": [[1.0, 2, 3], [0, 5, 1], [1, 2, 3]],
    "on a line": [[0.0, 0, 0], [1, 2, 3], [-2, -4, -6]],
    "on an axis": [[0.0, 0, 0], [0, 1, 0], [0, 2, 0]],
    "end repeated": [[0.0, 0, 0], [0.1, 0.2, 0.3], [0.1, 0.2, 0.3]],
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_triangles_without_area_have_rotations_and_finite_gradients(name, dtype):
    vertices = torch.tensor(DEGENERATE[name], dtype=dtype, requires_grad=True)
    frames = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))
    assert_rotations(frames.rotation, 1e-5)
    assert (frames.scale >= 0).all()
    sum(part.sum() for part in frames).backward()
    assert torch.isfinite(vertices.grad).all()


@pytest.mark.parametrize("size", [1e-4, 1e-2, 1.0, 1e2])
def test_thin_but_real_triangles_keep_their_normal_in_single_precision(size):
    vertices = size * torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 0, -1e-4]])
    frames = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))
    torch.testing.assert_close(frames.rotation[0, :, 1], torch.tensor([0.0, 1.0, 0.0]))
