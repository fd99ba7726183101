"""The image loss of Gaussian splatting: L1 and structural dissimilarity, fused with its gradient."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import BackendError, OptionError, ShapeError
from meshanim.operators import cpu_operator

try:
    from meshanim import _native
except ImportError:  # the extension is optional: "auto" takes the reference, "native" raises BackendError
    _native = None

__all__ = ["image_loss"]

_TAPS, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def image_loss(
    rendered: Float[Tensor, "*batch height width channels"],
    target: Float[Tensor, "*batch height width channels"],
    ssim_weight: float = 0.2,
    mask: Float[Tensor, "*batch height width"] | None = None,
    backend: Literal["auto", "native", "reference"] = "auto",
) -> Float[Tensor, ""]:
    """(1 - ssim_weight) L1 + ssim_weight (1 - SSIM), Eq. 7 of 3D Gaussian Splatting (Kerbl et al. 2023).

    SSIM is that of Wang et al. 2004 as torchmetrics computes it for values in [0, 1]: an 11 x 11 Gaussian
    window of sigma 1.5, the image mirrored beyond its border. (The original splatting code has zeros there.)
    The gradient goes to `rendered` alone.

    Parameters
    ----------
    rendered, target : (..., H, W, C)
        Images of at least 11 x 11 pixels, values in [0, 1] (others are not clamped).
    ssim_weight : float
        In [0, 1]; 3D Gaussian Splatting: 0.2.
    mask : (..., H, W), optional
        Weights of the pixels, not negative; both means are weighted by them. Windows see all pixels.
    backend : "auto", "native" or "reference"
        "native": C++, float32 on the CPU; "reference": torch, any type and device.

    Returns
    -------
    ()
        The loss over all images.

    Raises
    ------
    ShapeError
        If shapes do not fit, images are smaller than the window, or the mask is zero everywhere.
    OptionError
        If the weight lies outside [0, 1] or the backend does not exist.
    BackendError
        If "native" is asked for and is not built, or the tensors are of another type or device.
    """
    if not 0 <= ssim_weight <= 1:
        raise OptionError(f"ssim_weight must lie in [0, 1], not {ssim_weight}")
    if rendered.ndim < 3 or rendered.shape != target.shape:
        raise ShapeError(
            f"images must have one shape (..., H, W, C), not {tuple(rendered.shape)}, {tuple(target.shape)}"
        )
    height, width, channels = rendered.shape[-3:]
    if min(height, width) < _TAPS or rendered.numel() == 0:
        raise ShapeError(f"images must be at least {_TAPS} x {_TAPS} pixels, not {tuple(rendered.shape)}")
    if mask is not None and mask.shape != rendered.shape[:-1]:
        raise ShapeError(f"mask must be {tuple(rendered.shape[:-1])}, not {tuple(mask.shape)}")
    image, truth = (tensor.reshape(-1, height, width, channels) for tensor in (rendered, target))
    weights = None if mask is None else mask.reshape(-1, height, width)
    if _backend(backend, image, truth) == "native":
        loss, _ = _fused(image, truth, weights, ssim_weight, image.requires_grad and torch.is_grad_enabled())
        return loss
    return _reference(image, truth, weights, ssim_weight)


def _backend(backend: str, rendered: Tensor, target: Tensor) -> str:
    if backend not in ("auto", "native", "reference"):
        raise OptionError(f"no backend '{backend}'; there are auto, native, reference")
    fits = all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (rendered, target))
    if backend == "auto":
        return "native" if _native is not None and fits else "reference"
    if backend == "native" and _native is None:
        raise BackendError(
            "the native image loss is not built: install meshanim where there is a C++ compiler"
        )
    if backend == "native" and not fits:
        raise BackendError("the native image loss takes float32 on the CPU; use backend='reference'")
    return backend


def _share(shape: torch.Size, mask: Tensor | None) -> float:
    """What one channel of a pixel of weight 1 counts for in the mean."""
    if mask is None:
        return 1 / shape.numel()
    # Row by row: the sum is then the same for any number of threads.
    total = float(mask.sum(-1, dtype=torch.float64).sum())
    if total <= 0:
        raise ShapeError("the mask is zero everywhere: there is no pixel to compare")
    return 1 / (total * shape[-1])


@cpu_operator("image_loss")
def _fused(
    rendered: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float, keep: bool
) -> tuple[Tensor, Tensor]:
    share = _share(rendered.shape, mask)
    l1_scale, ssim_scale = (1 - ssim_weight) * share, ssim_weight * share
    rendered = rendered.detach().contiguous()
    gradient = torch.empty_like(rendered) if keep else None
    absolute, dissimilar = _native.image_loss(
        rendered,
        target.detach().contiguous(),
        None if mask is None else mask.detach().float().contiguous(),
        gradient,
        l1_scale,
        ssim_scale,
        torch.get_num_threads(),
    )
    loss = rendered.new_tensor(l1_scale * absolute + ssim_scale * dissimilar)
    return loss, rendered.new_empty(0) if gradient is None else gradient


@torch.library.register_fake(_fused)
def _(rendered, target, mask, ssim_weight, keep):
    return rendered.new_empty(()), rendered.new_empty(rendered.shape if keep else 0)


def _save(ctx, inputs, output):
    ctx.save_for_backward(output[1])
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)  # zeros as large as the image for it


def _backward(ctx, grad_loss, _):
    (gradient,) = ctx.saved_tensors
    return gradient * grad_loss, None, None, None, None


torch.library.register_autograd(_fused, _backward, setup_context=_save)


def _reference(rendered: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float) -> Tensor:
    target = target.detach()
    share, edge = _share(rendered.shape, mask), _TAPS // 2
    weight = rendered.new_ones(rendered.shape[:-1]) if mask is None else mask.detach().to(rendered)
    absolute = (weight[..., None] * (rendered - target).abs()).sum()
    distance = torch.arange(_TAPS, dtype=rendered.dtype, device=rendered.device) - edge
    taps = torch.softmax(-(distance**2) / (2 * _SIGMA**2), 0)

    def mean(values: Tensor) -> Tensor:
        flat = values.permute(0, 3, 1, 2).flatten(0, 1)[:, None]
        flat = torch.nn.functional.pad(flat, (edge, edge, edge, edge), mode="reflect")
        flat = torch.nn.functional.conv2d(flat, taps.view(1, 1, -1, 1))
        flat = torch.nn.functional.conv2d(flat, taps.view(1, 1, 1, -1))
        return flat[:, 0].unflatten(0, (len(values), -1)).permute(0, 2, 3, 1)

    x, y = mean(rendered), mean(target)
    xx, yy, xy = mean(rendered**2) - x * x, mean(target**2) - y * y, mean(rendered * target) - x * y
    ssim = (2 * x * y + _C1) * (2 * xy + _C2) / ((x * x + y * y + _C1) * (xx + yy + _C2))
    dissimilar = (weight[..., None] * (1 - ssim)).sum()
    return share * ((1 - ssim_weight) * absolute + ssim_weight * dissimilar)
