"""The C++ rasteriser under autograd."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from meshanim.errors import OptionError
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.splat.reference import check_values
from meshanim.gaussians.splat.rendering import RasterOptions, Rendering

try:
    from meshanim import _native
except ImportError:  # the extension is optional; `available` says so and rasterize raises BackendError
    _native = None

__all__ = ["available", "rasterize_native", "work"]

# From this many floats on, gradients come from the pool of the extension, which keeps their pages.
POOLED = 1 << 18


class _Views(NamedTuple):
    """What the kernels need besides tensors."""

    images: torch.Size
    cameras: int
    gaussians: int
    channels: int
    coefficients: int
    width: int
    height: int
    near: float
    far: float
    eps2d: float
    max_alpha: float
    antialiased: bool
    depth: bool


def available() -> bool:
    """Whether the extension was built."""
    return _native is not None


def rasterize_native(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "*#images channels"],
    images: torch.Size,
    options: RasterOptions,
    screen_offsets: Float[Tensor, "*images n 2"] | None,
) -> Rendering:
    """`rasterize` in C++: float32 on the CPU, the same bits for any number of threads.

    Raises
    ------
    OptionError
        If gradients to the intrinsics are asked for; the reference has them.
    """
    if cameras.intrinsics.requires_grad and torch.is_grad_enabled():
        raise OptionError("backend 'native' has no gradients to intrinsics: use backend='reference'")
    fields, views = _inputs(gaussians, cameras, background, images, options)
    if torch.is_grad_enabled() and any(
        tensor is not None and tensor.requires_grad for tensor in (*fields, screen_offsets)
    ):
        finite, rgb, alpha, depth, radii = _Rasterize.apply(*fields, screen_offsets, views)
    else:
        finite, rgb, alpha, depth, radii = _render(fields, views)[0]
    if not finite:
        check_values(gaussians)
        raise OptionError("a Gaussian's projection overflows float32: use backend='reference'")
    if options.depth == "expected":
        depth = depth / alpha.clamp_min(1e-10)
    return Rendering(rgb, alpha, depth, screen_offsets, radii)


def work(gaussians: Gaussians, cameras: Cameras) -> int:
    """How many pairs of pixel and Gaussian the kernels compute for these images, for benchmarks."""
    background = gaussians.means.new_zeros(3)
    options = RasterOptions(0.01, 1e10, 0.3, False, 0.999, None)
    images = torch.Size((*gaussians.batch_shape, len(cameras)))
    _, (*_, state) = _render(*_inputs(gaussians, cameras, background, images, options))
    return _native.splat_pairs(state)


def _inputs(
    gaussians: Gaussians, cameras: Cameras, background: Tensor, images: torch.Size, options: RasterOptions
) -> tuple[list[Tensor], _Views]:
    """Means, quaternions, scales, opacities, colours, poses, intrinsics, background: whole or shared."""
    colors = gaussians.colors if gaussians.sh is None else gaussians.sh
    assert colors is not None
    of_frame = (
        (gaussians.means, 2),
        (gaussians.quaternions, 2),
        (gaussians.scales, 2),
        (gaussians.opacities, 1),
        (colors, 2 if gaussians.sh is None else 3),
    )
    fields = [
        field if field.ndim == dimensions else _batched(field, images[:-1], dimensions)
        for field, dimensions in of_frame
    ]
    poses, intrinsics = cameras.world_to_camera, cameras.intrinsics
    if poses.shape[:-2] != images:
        poses = poses.expand(*images, 4, 4)
    if intrinsics.shape[:-2] != images:
        intrinsics = intrinsics.expand(*images, 3, 3)
    if background.numel() != math.prod(images) * background.shape[-1]:
        background = background.expand(*images, background.shape[-1])
    fields += [poses, intrinsics, background]
    views = _Views(
        images,
        len(cameras),
        len(gaussians),
        background.shape[-1],
        0 if gaussians.sh is None else gaussians.sh.shape[-2],
        cameras.width,
        cameras.height,
        options.near,
        min(options.far, 3e38),
        options.eps2d,
        options.max_alpha,
        options.antialiased,
        options.depth is not None,
    )
    return fields, views


def _batched(field: Tensor, batch: torch.Size, dimensions: int) -> Tensor:
    """The field, repeated if it has only a part of the batch: one that all share stays as it is."""
    own, rest = field.shape[: field.ndim - dimensions], field.shape[field.ndim - dimensions :]
    return field if math.prod(own) in (1, math.prod(batch)) else field.expand(*batch, *rest)


def _render(fields: Sequence[Tensor], views: _Views) -> tuple[tuple, list[Tensor]]:
    """(finite, rgb, alpha, depth or None, radii) and what backward needs, outside autograd.

    Addresses go to the kernels, not arrays: to make eight of those takes as long as a small image. What is
    returned keeps the memory that the state refers to.
    """
    fields = [_plain(field) for field in fields]
    size = (*views.images, views.height, views.width)
    rgb, alpha = _empty((*size, views.channels)), _empty(size)
    depth = _empty(size) if views.depth else None
    radii = torch.empty((*views.images, views.gaussians, 2), dtype=torch.int32)
    scene = _native.SplatScene(
        [field.data_ptr() for field in fields],
        [field.numel() for field in fields],
        math.prod(views.images),
        *views[1:],
        torch.get_num_threads(),
    )
    finite, state = _native.splat_forward(
        scene, rgb.data_ptr(), alpha.data_ptr(), 0 if depth is None else depth.data_ptr(), radii.data_ptr()
    )
    return (finite, rgb, alpha, depth, radii), [*fields, state]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *given):
        *fields, _, views = given
        outputs, kept = _render(fields, views)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(outputs[-1])
        ctx.save_for_backward(*kept)
        ctx.images = views.images
        return outputs

    @staticmethod
    def backward(ctx, *grads):
        return _backward_once(ctx, *grads) if torch.is_grad_enabled() else _backward(ctx, *grads)


def _backward(ctx, _, grad_rgb, grad_alpha, grad_depth, __):
    *fields, state = ctx.saved_tensors
    grads = [_empty_like(field) if wanted else None for field, wanted in zip(fields, ctx.needs_input_grad)]
    *_, to_offsets, _ = ctx.needs_input_grad
    grads.append(_empty((*ctx.images, fields[0].shape[-2], 2)) if to_offsets else None)
    targets = [0 if grad is None else grad.data_ptr() for grad in grads]
    del targets[_INTRINSICS]
    of_images = [
        None if grad is None else grad.resolve_neg().flatten(0, len(ctx.images) - 1)
        for grad in (grad_rgb, grad_alpha, grad_depth)
    ]
    _native.splat_backward(state.numpy(), *map(_strided, of_images), targets)
    return *grads, None


_backward_once = once_differentiable(_backward)
_INTRINSICS = 6  # among the fields; gradients to them are the reference's alone


def _plain(tensor: Tensor) -> Tensor:
    """Its values in contiguous memory, which stays whatever becomes of the tensor."""
    tensor = tensor.detach()
    return tensor.resolve_neg().contiguous() if tensor.is_neg() or not tensor.is_contiguous() else tensor


def _strided(grad: Tensor | None) -> tuple[int, ...]:
    """Address and strides of (images, height, width[, channels])."""
    if grad is None:
        return (0,) * 5
    strides = grad.stride()
    return (grad.data_ptr(), *strides, 0) if len(strides) == 3 else (grad.data_ptr(), *strides)


def _empty(shape: tuple[int, ...]) -> Tensor:
    return _native.empty(shape) if math.prod(shape) >= POOLED else torch.empty(*shape)


def _empty_like(tensor: Tensor) -> Tensor:
    return _native.empty(tensor.shape) if tensor.numel() >= POOLED else torch.empty_like(tensor)
