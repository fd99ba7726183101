"""The fused image loss against torchmetrics, its torch reference and finite differences."""

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from meshanim import _native
from meshanim.errors import BackendError, OptionError, ShapeError
from meshanim.gaussians import loss_benchmark
from meshanim.gaussians.losses import image_loss

SIZES = [(11, 11, 3), (12, 300, 3), (40, 33, 1), (37, 513, 4), (70, 258, 3)]


def images(*shape: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth picture with edges, and a noisy copy."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand((*shape[:-3], shape[-1], 6, 6), generator=generator)
    truth = torch.nn.functional.interpolate(coarse.reshape(-1, 1, 6, 6), size=shape[-3:-1], mode="bilinear")
    truth = truth.reshape(*shape[:-3], shape[-1], *shape[-3:-1]).movedim(-3, -1).contiguous()
    truth[..., : shape[-2] // 2, :] *= 0.4
    noisy = truth + 0.1 * torch.randn(shape, generator=generator)
    noisy[..., :3, :, :] = truth[..., :3, :, :]  # equal there: |x - y| has no slope
    return noisy, truth


@pytest.mark.parametrize("shape", SIZES)
def test_ssim_is_that_of_torchmetrics(shape):
    noisy, truth = images(2, *shape)
    planes = (noisy.double().movedim(-1, 1), truth.double().movedim(-1, 1))
    wanted = float(structural_similarity_index_measure(*planes, data_range=1.0))
    for backend in ("native", "reference"):
        assert float(1 - image_loss(noisy, truth, 1.0, backend=backend)) == pytest.approx(wanted, abs=1e-5)
    assert float(image_loss(noisy, truth, 0.0)) == pytest.approx(
        float((noisy - truth).abs().mean()), rel=1e-5
    )


@pytest.mark.parametrize("isa", ["generic", "avx2", "avx512"])
@pytest.mark.parametrize("masked", [False, True])
def test_native_is_the_reference_forward_and_backward(isa, masked):
    best = _native.instruction_set()
    try:
        _native.set_instruction_set(isa)
    except ValueError:
        pytest.skip("not on this processor")
    try:
        for shape in SIZES:
            noisy, truth = images(2, *shape)
            mask = torch.rand(noisy.shape[:-1]).round(decimals=1) if masked else None
            exact = noisy.double().requires_grad_()
            wanted = image_loss(exact, truth.double(), 0.3, None if mask is None else mask.double())
            wanted.backward()
            noisy.requires_grad_()
            loss = image_loss(noisy, truth, 0.3, mask, backend="native")
            (2 * loss).backward()
            assert loss.item() == pytest.approx(wanted.item(), rel=1e-5)
            assert (noisy.grad / 2 - exact.grad).norm() < 2e-5 * exact.grad.norm(), shape
    finally:
        _native.set_instruction_set(best)


def test_reference_gradient_by_finite_differences():
    noisy, truth = images(13, 12, 2)
    mask = torch.rand(13, 12).double()
    noisy = (noisy + 0.05).double().requires_grad_()  # nowhere equal
    assert torch.autograd.gradcheck(lambda x: image_loss(x, truth.double(), 0.4, mask), noisy)


def test_same_bits_for_any_number_of_threads():
    noisy, truth = images(3, 71, 300, 3)
    mask = torch.rand(3, 71, 300)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            leaf = noisy.clone().requires_grad_()
            loss = image_loss(leaf, truth, mask=mask, backend="native")
            loss.backward()
            results.append((loss, leaf.grad))
    finally:
        torch.set_num_threads(before)
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_equal_images_cost_nothing():
    _, truth = images(30, 31, 3)
    leaf = truth.clone().requires_grad_()
    loss = image_loss(leaf, truth)
    loss.backward()
    assert abs(loss.item()) < 1e-6
    assert leaf.grad.abs().max() < 1e-7


def test_mask_leaves_only_its_pixels():
    noisy, truth = images(40, 50, 3)
    mask = torch.zeros(40, 50)
    mask[8:32, 6:40] = 1
    window = noisy[8:32, 6:40].sub(truth[8:32, 6:40]).abs().mean()
    assert image_loss(noisy, truth, 0.0, mask).item() == pytest.approx(window.item(), rel=1e-5)
    spoiled = noisy.clone()
    spoiled[:3, 45:] = 0.5  # beyond the reach of every window in the mask
    assert torch.equal(image_loss(noisy, truth, 0.5, mask), image_loss(spoiled, truth, 0.5, mask))


def test_nan_is_not_lost():
    noisy, truth = images(30, 31, 3)
    noisy[17, 20, 1] = float("nan")
    for backend in ("native", "reference"):
        assert image_loss(noisy, truth, backend=backend).isnan()


def test_what_does_not_fit_is_named(unchecked):
    noisy, truth = images(20, 21, 3)
    with pytest.raises(ShapeError, match="one shape"):
        image_loss(noisy, truth[:-1])
    with pytest.raises(ShapeError, match="11 x 11"):
        image_loss(noisy[:10], truth[:10])
    with pytest.raises(ShapeError, match="mask must be"):
        image_loss(noisy, truth, mask=torch.ones(20, 20))
    with pytest.raises(ShapeError, match="zero everywhere"):
        image_loss(noisy, truth, mask=torch.zeros(20, 21))
    with pytest.raises(OptionError, match="ssim_weight"):
        image_loss(noisy, truth, 1.5)
    with pytest.raises(OptionError, match="backend"):
        image_loss(noisy, truth, backend="numpy")
    with pytest.raises(BackendError, match="float32"):
        image_loss(noisy.double(), truth.double(), backend="native")


def test_benchmark_compares_every_size():
    results = loss_benchmark.run(loss_benchmark.LossBenchmark(sizes=(16, 24), repeats=1))
    assert {row.case for row in results.rows} == {"16 x 16", "24 x 24"}
    for name in ("torchmetrics", "reference", "native"):
        assert results.value("16 x 16", name, "forward + backward") > 0
