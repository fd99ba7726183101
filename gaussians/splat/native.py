"""The C++ rasteriser under autograd."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
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
    coefficients: int
    cameras: int
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
    background: Float[Tensor, "*images channels"],
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
    fields, views = _inputs(gaussians, cameras, background, options)
    if torch.is_grad_enabled() and any(
        tensor is not None and tensor.requires_grad for tensor in (*fields, screen_offsets)
    ):
        finite, rgb, alpha, depth, radii = _Rasterize.apply(*fields, screen_offsets, views)
    else:
        finite, rgb, alpha, depth, radii, _ = _render(fields, views)
    if not finite:
        check_values(gaussians)
        raise OptionError("a Gaussian's projection overflows float32: use backend='reference'")
    if options.depth == "expected":
        depth = depth / alpha.clamp_min(1e-10)
    return Rendering(rgb, alpha, depth, screen_offsets, radii)


def work(gaussians: Gaussians, cameras: Cameras) -> int:
    """How many pairs of pixel and Gaussian the kernels compute for these images, for benchmarks."""
    background = gaussians.means.new_zeros(len(cameras), 3)
    options = RasterOptions(0.01, 1e10, 0.3, False, 0.999, None)
    *_, state = _render(*_inputs(gaussians, cameras, background, options))
    return _native.splat_pairs(state)


def _inputs(
    gaussians: Gaussians, cameras: Cameras, background: Tensor, options: RasterOptions
) -> tuple[list[Tensor], _Views]:
    """Tensors in the order of `_INPUTS`, without the offsets: each has the whole batch or none."""
    images = background.shape[:-1]
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
    fields += [poses, intrinsics, background]
    views = _Views(
        images,
        0 if gaussians.sh is None else gaussians.sh.shape[-2],
        len(cameras),
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


def _render(fields: Sequence[Tensor], views: _Views):
    """(finite, rgb, alpha, depth or None, radii, state), outside autograd."""
    finite, planes, radii, state = _native.splat_forward(_scene(fields, views))
    size, channels = (views.height, views.width), fields[7].shape[-1]
    planes, radii = planes.view(*views.images, -1, *size), radii.view(*views.images, -1, 2)
    alpha = planes.select(-3, -1)
    depth = planes.select(-3, channels) if views.depth else None
    return finite, planes.narrow(-3, 0, channels).movedim(-3, -1), alpha, depth, radii, state


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *given):
        *fields, offsets, views = given
        *outputs, state = _render(fields, views)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(outputs[-1])
        ctx.save_for_backward(*fields, state)
        ctx.batch_dimensions, ctx.offsets = (
            len(views.images),
            torch.Size() if offsets is None else offsets.shape,
        )
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, _, grad_rgb, grad_alpha, grad_depth, __):
        *fields, state = ctx.saved_tensors
        shapes = [*(field.shape for field in fields), ctx.offsets]
        grads = [_empty(shape) if wanted else None for shape, wanted in zip(shapes, ctx.needs_input_grad)]
        means, quaternions, scales, opacities, colors, poses, _, background, offsets = map(_array, grads)
        last = ctx.batch_dimensions - 1
        of_images = (
            None if g is None else g.flatten(0, last).numpy() for g in (grad_rgb, grad_alpha, grad_depth)
        )
        _native.splat_backward(
            state.numpy(),
            *of_images,
            means,
            quaternions,
            scales,
            opacities,
            colors,
            offsets,
            background,
            poses,
        )
        return *grads, None


def _scene(fields: Sequence[Tensor], views: _Views):
    means, quaternions, scales, opacities, colors, poses, intrinsics, background = (
        field.detach().contiguous().numpy() for field in fields
    )
    n, coefficients = means.shape[-2], views.coefficients
    return _native.SplatScene(
        _rows(means, n, 3),
        _rows(quaternions, n, 4),
        _rows(scales, n, 3),
        _rows(opacities, n),
        _rows(colors, n, 3 * coefficients or colors.shape[-1]),
        coefficients,
        _rows(poses, 4, 4),
        _rows(intrinsics, 3, 3),
        _rows(background, background.shape[-1]),
        *views[2:],
        torch.get_num_threads(),
    )


def _rows(array: np.ndarray, *rest: int) -> np.ndarray:
    """Its leading dimensions as one. Explicit, for -1 is ambiguous where there are no Gaussians."""
    each = math.prod(rest)
    return array.reshape(array.size // each if each else 1, *rest)


def _empty(shape: torch.Size) -> Tensor:
    return _native.empty(shape) if math.prod(shape) >= POOLED else torch.empty(shape)


def _array(tensor: Tensor | None) -> np.ndarray | None:
    return None if tensor is None else tensor.numpy()
