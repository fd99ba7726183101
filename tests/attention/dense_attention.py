"""The second implementation: torch's dense attention with the graph's mask, and meshes to try it on."""

import numpy as np
import torch
import trimesh


def dense_attention(query, key, value, graph, scale=None):
    """Quadratic in the tokens; zeros where a row of the mask is empty."""
    mask = graph.allowed()
    empty = ~mask.any(1)
    heads_first = [tensor.transpose(1, 2) for tensor in (query, key, value)]
    out = torch.nn.functional.scaled_dot_product_attention(
        *heads_first, attn_mask=mask | empty[:, None], scale=scale
    )
    return out.transpose(1, 2).masked_fill(empty[None, :, None, None], 0.0)


def sphere(subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def random_inputs(graph, batch, heads, dim, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, graph.n_tokens, heads, dim)
    return tuple(torch.randn(shape, dtype=dtype, generator=generator).requires_grad_() for _ in range(3))
