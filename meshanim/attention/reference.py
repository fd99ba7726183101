"""Sparse mesh attention in plain torch: the oracle of the tests, and the fallback on any device."""

import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.attention.graph import MeshGraph

__all__ = ["attention_reference", "edge_probabilities"]


def attention_reference(
    query: Float[Tensor, "batch tokens heads dim"],
    key: Float[Tensor, "batch tokens heads dim"],
    value: Float[Tensor, "batch tokens heads dim"],
    graph: MeshGraph,
    scale: float,
) -> Float[Tensor, "batch tokens heads dim"]:
    """`mesh_attention` by gathering a row an edge: time and memory linear in edges, any float type."""
    probabilities, global_row = edge_probabilities(query, key, graph, scale)
    messages = probabilities[..., None] * value[:, graph.keys]
    out = torch.zeros_like(value).index_add(1, graph.queries, messages)
    if global_row is None:
        return out
    return torch.cat([out[:, :-1], torch.einsum("bth,bthd->bhd", global_row, value)[:, None]], dim=1)


def edge_probabilities(
    query: Float[Tensor, "batch tokens heads dim"],
    key: Float[Tensor, "batch tokens heads dim"],
    graph: MeshGraph,
    scale: float,
) -> tuple[Float[Tensor, "batch edges heads"], Float[Tensor, "batch tokens heads"] | None]:
    """What each edge's query gives to its key, and the global token's row where there is one."""
    queries = graph.queries
    scores = (query[:, queries] * key[:, graph.keys]).sum(-1) * scale
    rows = queries.long()[None, :, None].expand_as(scores)
    empty = query.new_full(query.shape[:3], -torch.inf)
    largest = empty.scatter_reduce(1, rows, scores.detach(), "amax")
    exponentials = (scores - largest[:, queries]).exp()
    sums = torch.zeros_like(empty).index_add(1, queries, exponentials)
    probabilities = exponentials / sums[:, queries]
    if not graph.global_token:
        return probabilities, None
    global_scores = torch.einsum("bhd,bthd->bth", query[:, -1], key) * scale
    return probabilities, global_scores.softmax(dim=1)
