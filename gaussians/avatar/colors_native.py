"""The colour network in C++ under autograd: float32 on the CPU, the same bits for any number of threads."""

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

try:
    from meshanim import _native
except ImportError:  # the extension is optional; `available` says so and ExpressionColors raises BackendError
    _native = None

__all__ = ["available", "color_network"]


def available() -> bool:
    """Whether the extension was built."""
    return _native is not None


def color_network(
    latents: Float32[Tensor, "n latent"],
    frame: Float32[Tensor, "batch hidden"],
    by_latent: Float32[Tensor, "latent hidden"],
    inner: Float32[Tensor, "hidden hidden"],
    inner_bias: Float32[Tensor, " hidden"],
    outer: Float32[Tensor, "hidden 3"],
    constant: Float32[Tensor, "n 3"] | None = None,
    others: Float32[Tensor, "n rest"] | None = None,
    scale: float = 1.0,
) -> Float32[Tensor, "batch n three_and_rest"]:
    """[constant + scale relu(relu(frame + latents by_latent) inner + inner_bias) outer; others].

    Differentiable in all tensors. The hidden layers stay in the cache, tile by tile, and are computed again
    for the gradients.
    """
    others = latents.new_empty(len(latents), 0) if others is None else others
    given = (latents, frame, by_latent, inner, inner_bias, outer, constant, others)
    return _ColorNetwork.apply(scale, *(None if tensor is None else tensor.contiguous() for tensor in given))


class _ColorNetwork(torch.autograd.Function):
    @staticmethod
    def forward(ctx, scale, *given):
        latents, frame, *_, others = given
        ctx.save_for_backward(*given)
        ctx.scale = scale
        out = latents.new_empty(len(frame), len(latents), 3 + others.shape[1])
        _native.color_network(*map(_array, given), scale, torch.get_num_threads(), out.numpy())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        given = ctx.saved_tensors
        gradients = [None if tensor is None else torch.empty_like(tensor) for tensor in given]
        for place in (-2, -1):
            if not ctx.needs_input_grad[place]:
                gradients[place] = None
        _native.color_network_backward(
            *map(_array, given),
            ctx.scale,
            _array(grad_out.contiguous()),
            torch.get_num_threads(),
            *map(_array, gradients),
        )
        return None, *gradients


def _array(tensor: Tensor | None):
    return None if tensor is None else tensor.detach().numpy()
