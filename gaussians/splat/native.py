"""The C++ rasteriser under autograd."""

import math
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
    images = background.shape[:-1]
    tensors, views = _inputs(gaussians, cameras, background, options)
    finite, rgb, alpha, depth, radii = _Rasterize.apply(*tensors, screen_offsets, views)
    if not finite:
        check_values(gaussians)
        raise OptionError("a Gaussian's projection overflows float32: use backend='reference'")
    if options.depth == "expected":
        depth = depth / alpha.clamp_min(1e-10)
    size = (*images, cameras.height, cameras.width)
    return Rendering(
        rgb.unflatten(0, images),
        alpha.view(size),
        None if depth is None else depth.view(size),
        screen_offsets,
        radii.view(*images, len(gaussians), 2),
    )


def work(gaussians: Gaussians, cameras: Cameras) -> int:
    """How many pairs of pixel and Gaussian the kernels compute for these images, for benchmarks."""
    background = gaussians.means.new_zeros(len(cameras), 3)
    options = RasterOptions(0.01, 1e10, 0.3, False, 0.999, None)
    *_, state = _native.splat_forward(_scene(*_inputs(gaussians, cameras, background, options)))
    return _native.splat_pairs(state)


def _inputs(
    gaussians: Gaussians, cameras: Cameras, background: Tensor, options: RasterOptions
) -> tuple[list[Tensor], _Views]:
    """Tensors in the order of `_INPUTS`, without the offsets, as the kernels read them."""
    images = background.shape[:-1]
    colors = gaussians.colors if gaussians.sh is None else gaussians.sh.flatten(-2)
    assert colors is not None
    tensors = [
        *(
            _frames(field, 2, images[:-1])
            for field in (gaussians.means, gaussians.quaternions, gaussians.scales)
        ),
        _frames(gaussians.opacities, 1, images[:-1]),
        _frames(colors, 2, images[:-1]),
        cameras.world_to_camera.expand(*images, 4, 4).reshape(-1, 4, 4).contiguous(),
        cameras.intrinsics.expand(*images, 3, 3).reshape(-1, 3, 3).contiguous(),
        background.reshape(-1, background.shape[-1]).contiguous(),
    ]
    views = _Views(
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
    return tensors, views


def _frames(field: Tensor, dimensions: int, batch: torch.Size) -> Tensor:
    """(1 or frames, N, ...): a field that all frames share stays as it is."""
    own, rest = field.shape[: field.ndim - dimensions], field.shape[field.ndim - dimensions :]
    if math.prod(own) not in (1, math.prod(batch)):
        field, own = field.expand(*batch, *rest), batch
    return field.reshape(math.prod(own), *rest).contiguous()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, means, quaternions, scales, opacities, colors, poses, intrinsics, background, offsets, views
    ):
        tensors = means, quaternions, scales, opacities, colors, poses, intrinsics, background
        finite, planes, radii, state = _native.splat_forward(_scene(tensors, views))
        channels = background.shape[-1]
        rgb = planes[:, :channels].permute(0, 2, 3, 1)
        depth = planes[:, channels] if views.depth else None
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        ctx.save_for_backward(*tensors, state)
        ctx.views, ctx.offsets = views, None if offsets is None else offsets.shape
        return finite, rgb, planes[:, -1], depth, radii

    @staticmethod
    @once_differentiable
    def backward(ctx, _, grad_rgb, grad_alpha, grad_depth, __):
        *tensors, state = ctx.saved_tensors
        wanted = dict(zip(_INPUTS, ctx.needs_input_grad))
        shapes = dict(zip(_INPUTS, (tensor.shape for tensor in tensors))) | {"offsets": ctx.offsets}
        grads = {name: _empty(shapes[name]) if wanted[name] else None for name in _INPUTS}
        _native.splat_backward(
            _scene(tensors, ctx.views),
            state,
            grad_rgb,
            grad_alpha,
            grad_depth,
            *(grads[name] for name in ("means", "quaternions", "scales", "opacities", "colors")),
            grads["offsets"],
            grads["background"],
            grads["poses"],
        )
        return *grads.values(), None


_INPUTS = (
    "means",
    "quaternions",
    "scales",
    "opacities",
    "colors",
    "poses",
    "intrinsics",
    "background",
    "offsets",
)


def _scene(tensors: tuple[Tensor, ...] | list[Tensor], views: _Views):
    means, quaternions, scales, opacities, colors, poses, intrinsics, background = (
        tensor.detach().numpy() for tensor in tensors
    )
    return _native.SplatScene(
        means,
        quaternions,
        scales,
        opacities,
        colors,
        views.coefficients,
        poses,
        intrinsics,
        background,
        *views[1:],
        torch.get_num_threads(),
    )


def _empty(shape: torch.Size) -> Tensor:
    return _native.empty(shape) if math.prod(shape) >= POOLED else torch.empty(shape)
