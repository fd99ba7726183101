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
) -> Float32[Tensor, "batch n 3"]:
    """relu(relu(frame + latents by_latent) inner + inner_bias) outer, differentiable in everything.

    The hidden layers stay in the cache, tile by tile, and are computed again for the gradients.
    """
    given = (latents, frame, by_latent, inner, inner_bias, outer)
    return _ColorNetwork.apply(*(tensor.contiguous() for tensor in given))


class _ColorNetwork(torch.autograd.Function):
    @staticmethod
    def forward(ctx, latents, frame, *weights):
        ctx.save_for_backward(latents, frame, *weights)
        out = latents.new_empty(len(frame), len(latents), 3)
        arrays = (tensor.detach().numpy() for tensor in (latents, frame, *weights))
        _native.color_network(*arrays, torch.get_num_threads(), out.numpy())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_out):
        given = ctx.saved_tensors
        gradients = [torch.empty_like(tensor) for tensor in given]
        arrays = (tensor.detach().numpy() for tensor in (*given, grad_out.contiguous()))
        out = (tensor.numpy() for tensor in gradients)
        _native.color_network_backward(*arrays, torch.get_num_threads(), *out)
        return tuple(gradients)
