"""The C++ kernels as torch operators that autograd, autocast and torch.compile understand."""

import torch
from torch import Tensor

from meshanim.attention.graph import MeshGraph
from meshanim.operators import cpu_operator, once_differentiable

try:
    from meshanim import _native
except ImportError:  # the extension is optional; `available` says so and mesh_attention raises BackendError
    _native = None

__all__ = ["attention_native", "available"]

# From this many floats on, outputs come from the pool of the extension: malloc hands such blocks back to the
# kernel, and clearing their pages again at every step costs more than the attention itself.
POOLED = 1 << 18


def available() -> bool:
    """Whether the extension was built."""
    return _native is not None


def attention_native(query: Tensor, key: Tensor, value: Tensor, graph: MeshGraph, scale: float) -> Tensor:
    """`mesh_attention` in C++: float32 on the CPU."""
    keep = torch.is_grad_enabled() and (query.requires_grad or key.requires_grad or value.requires_grad)
    out, _ = _forward(
        _rows(query),
        _rows(key),
        _rows(value),
        graph.order,
        graph.offsets,
        graph.keys,
        graph.received_offsets,
        graph.received_edges,
        graph.received_queries,
        graph.global_token,
        scale,
        keep,
    )
    return out


def _rows(tensor: Tensor) -> Tensor:
    # The kernels take any batch and token stride; heads and dim must lie together.
    whole = tensor.stride(3) == 1 and tensor.stride(2) == tensor.shape[3]
    return tensor if whole else tensor.contiguous()


@cpu_operator("mesh_attention")
def _forward(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    order: Tensor,
    offsets: Tensor,
    keys: Tensor,
    received_offsets: Tensor,
    received_edges: Tensor,
    received_queries: Tensor,
    global_token: bool,
    scale: float,
    keep: bool,
) -> tuple[Tensor, Tensor]:
    out, probabilities = (_empty(shape) for shape in _shapes(query, keys, global_token, keep))
    _native.attention_forward(
        query.detach(),
        key.detach(),
        value.detach(),
        order,
        offsets,
        keys,
        received_offsets,
        received_edges,
        received_queries,
        global_token,
        scale,
        torch.get_num_threads(),
        out,
        probabilities,
    )
    return out, probabilities


def _shapes(query: Tensor, keys: Tensor, global_token: bool, keep: bool) -> tuple[torch.Size, torch.Size]:
    batch, tokens, heads, _ = query.shape
    width = 1 << max(heads - 1, 0).bit_length()
    edges = keys.shape[0] + (tokens if global_token else 0)
    return query.shape, torch.Size((batch, edges, width) if keep else (0, 0, 0))


def _empty(shape: torch.Size) -> Tensor:
    return _native.empty(shape) if shape.numel() >= POOLED else torch.empty(shape, dtype=torch.float32)


@torch.library.register_fake(_forward)
def _(query, key, value, order, offsets, keys, r_offsets, r_edges, r_queries, global_token, scale, keep):
    out, probabilities = _shapes(query, keys, global_token, keep)
    return query.new_empty(out), query.new_empty(probabilities)


@cpu_operator("mesh_attention_backward")
def _backward(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    order: Tensor,
    offsets: Tensor,
    keys: Tensor,
    received_offsets: Tensor,
    received_edges: Tensor,
    received_queries: Tensor,
    global_token: bool,
    scale: float,
    out: Tensor,
    probabilities: Tensor,
    grad_out: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    grads = (_empty(query.shape), _empty(query.shape), _empty(query.shape))
    _native.attention_backward(
        query.detach(),
        key.detach(),
        value.detach(),
        order,
        offsets,
        keys,
        received_offsets,
        received_edges,
        received_queries,
        global_token,
        scale,
        torch.get_num_threads(),
        out.detach(),
        probabilities.detach(),
        grad_out.detach(),
        _empty(probabilities.shape),
        *grads,
    )
    return grads


@torch.library.register_fake(_backward)
def _(
    query, key, value, order, offsets, keys, r_offsets, r_edges, r_queries, global_token, scale, out, p, grad
):
    return query.new_empty(query.shape), query.new_empty(query.shape), query.new_empty(query.shape)


def _setup(ctx, inputs, output) -> None:
    *tensors, ctx.global_token, ctx.scale, _ = inputs
    ctx.save_for_backward(*tensors, *output)


def _differentiate(ctx, grad_out: Tensor, _) -> tuple[Tensor | None, ...]:
    *tensors, out, probabilities = ctx.saved_tensors
    grads = _backward(*tensors, ctx.global_token, ctx.scale, out, probabilities, _rows(grad_out))
    return *grads, *(None,) * 9


torch.library.register_autograd(_forward, _differentiate, setup_context=_setup)
once_differentiable(_backward)
