import numpy as np
import pytest
import torch

from meshanim.errors import ShapeError
from meshanim.training.losses import (
    LossWeights,
    eye_loss,
    pose_loss,
    reconstruction_loss,
    velocity_loss,
)


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(2, 4, 5, 3, generator=generator, dtype=torch.float64) * 1e-3 for _ in range(2)]


def test_the_weights_are_the_papers():
    assert LossWeights() == LossWeights(reconstruction=1.0, velocity=10.0, pose=0.001, eyes=0.005)


def test_reconstruction_against_numpy(pair):
    predicted, true = (x.numpy() * 1000 for x in pair)
    expected = np.mean([np.sum((p - t) ** 2) for p, t in zip(predicted.reshape(-1, 3), true.reshape(-1, 3))])
    assert reconstruction_loss(*pair).item() == pytest.approx(expected)


def test_one_millimetre_costs_one():
    true = torch.zeros(1, 7, 3)
    predicted = true.clone()
    predicted[..., 1] = 1e-3
    assert reconstruction_loss(predicted, true).item() == pytest.approx(1)


def test_vertex_weights_of_any_scale_and_their_zeros(pair):
    even = reconstruction_loss(*pair)
    assert reconstruction_loss(*pair, torch.full((5,), 7.0, dtype=torch.float64)).item() == pytest.approx(
        even.item()
    )
    only = torch.tensor([0, 0, 1, 0, 0], dtype=torch.float64)
    alone = reconstruction_loss(pair[0][..., 2:3, :], pair[1][..., 2:3, :])
    assert reconstruction_loss(*pair, only).item() == pytest.approx(alone.item())


def test_velocity_ignores_a_constant_offset(pair):
    predicted, true = pair
    assert velocity_loss(true + 0.01, true).item() == pytest.approx(0, abs=1e-20)
    difference = (np.diff(predicted.numpy(), axis=1) - np.diff(true.numpy(), axis=1)) * 1000
    assert velocity_loss(predicted, true).item() == pytest.approx((difference**2).sum(-1).mean())
    with pytest.raises(ShapeError, match="two consecutive frames"):
        velocity_loss(predicted[:, :1], true[:, :1])


def test_eye_loss_is_the_divergence_of_the_fitted_normals():
    generator = torch.Generator().manual_seed(1)
    predicted = torch.randn(50, 4, 3, generator=generator, dtype=torch.float64) * 2e-3 + 1e-3
    true = torch.randn(50, 4, 3, generator=generator, dtype=torch.float64) * 1e-3
    eyes = torch.tensor([1, 3])
    values = []
    for j in (1, 3):
        for axis in range(3):
            p = torch.distributions.Normal(
                predicted[:, j, axis].mean(), (predicted[:, j, axis].var(correction=0) + 1e-8).sqrt()
            )
            t = torch.distributions.Normal(
                true[:, j, axis].mean(), (true[:, j, axis].var(correction=0) + 1e-8).sqrt()
            )
            values.append(torch.distributions.kl_divergence(p, t).item())
    assert eye_loss(predicted, true, eyes).item() == pytest.approx(np.mean(values), rel=1e-6)
    assert eye_loss(true, true, eyes).item() == pytest.approx(0, abs=1e-12)
    shuffled = predicted[torch.randperm(50, generator=generator)]
    assert eye_loss(shuffled, true, eyes).item() == pytest.approx(eye_loss(predicted, true, eyes).item())


def test_eyes_at_rest_give_finite_gradients():
    predicted = torch.zeros(4, 2, 3, requires_grad=True)
    loss = eye_loss(predicted, torch.zeros(4, 2, 3), torch.tensor([0, 1]))
    loss.backward()
    assert loss.item() == 0
    assert torch.isfinite(predicted.grad).all()
    with pytest.raises(ShapeError, match="at least two"):
        eye_loss(predicted[:1], predicted[:1], torch.tensor([0]))


def test_pose_loss_and_its_gradient_at_zero():
    predicted = torch.zeros(2, 3, requires_grad=True)
    true = torch.tensor([[0.3, 0.0, 0.4], [0.0, 0.0, 0.0]])
    loss = pose_loss(predicted, true)
    loss.backward()
    assert loss.item() == pytest.approx(0.25)
    assert torch.isfinite(predicted.grad).all()


def test_gradients(pair):
    predicted, true = pair[0].requires_grad_(), pair[1]
    weights = torch.rand(5, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: reconstruction_loss(x, true, weights), predicted)
    assert torch.autograd.gradcheck(lambda x: velocity_loss(x, true, weights), predicted)
    eyes = torch.tensor([0, 4])
    assert torch.autograd.gradcheck(lambda x: eye_loss(x.flatten(0, 1), true.flatten(0, 1), eyes), predicted)
    assert torch.autograd.gradcheck(lambda x: pose_loss(x[..., 0, :], true[..., 0, :]), predicted)
