"""`mesh_attention`: one signature, three backends."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.attention import native
from meshanim.attention.graph import MeshGraph
from meshanim.attention.native import attention_native
from meshanim.attention.reference import attention_reference, edge_probabilities
from meshanim.errors import BackendError, OptionError, ShapeError

__all__ = ["BACKENDS", "AttentionMaps", "attention_maps", "mesh_attention"]

BACKENDS = ("auto", "native", "cuda", "reference")


@dataclass(frozen=True)
class AttentionMaps:
    """Where attention goes, per head.

    Parameters
    ----------
    received : (B, V, H)
        The most that any vertex gives to this vertex: the column maximum of the attention matrix without
        the global token (GAVA's audio attention map, Fig. 10). Zero where no vertex attends to it.
    global_row : (B, V, H), optional
        What the global token gives to each vertex (GAVA's pose attention map, Fig. 7).
    """

    received: Float[Tensor, "batch vertices heads"]
    global_row: Float[Tensor, "batch vertices heads"] | None


def mesh_attention(
    query: Float[Tensor, "batch tokens heads dim"],
    key: Float[Tensor, "batch tokens heads dim"],
    value: Float[Tensor, "batch tokens heads dim"],
    graph: MeshGraph,
    backend: str = "auto",
    scale: float | None = None,
) -> Float[Tensor, "batch tokens heads dim"]:
    """Multi-head attention in which a token sees only its neighbours in `graph`.

    out_i = sum over allowed j of softmax_j(scale q_i . k_j) v_j, with time and memory linear in the edges.

    GAVA's Eq. 1 multiplies the scores by a mask of ones and minus infinity; taken literally, a negative score
    of a forbidden pair would become plus infinity. The mask here is the additive one: forbidden pairs get
    minus infinity, allowed pairs keep their score. A token with no allowed key (an isolated vertex without
    self-loops) gets zeros, where a dense softmax would give NaN.

    Parameters
    ----------
    query, key, value : (B, T, H, D) float
        T = vertices, plus the global token, last, where the graph has one. Views into one fused projection
        are read in place. Half and bfloat16 are computed in float32.
    graph : MeshGraph
        On the same device.
    backend : str
        "native" (C++, CPU, float32), "reference" (torch, a row an edge: any device and type), "cuda"
        (the gathering form, only on an NVIDIA GPU) or "auto": native where it is built and applies, the
        reference otherwise and for float64.
    scale : float, optional
        1 / sqrt(D) if not given.

    Returns
    -------
    (B, T, H, D) of the inputs' type.

    Raises
    ------
    ShapeError, OptionError, BackendError
        Shapes or devices that do not fit together; an unknown backend; one that is not there.

    Source: Li et al., "Pose-Aware 3D Talking Face Synthesis using Geometry-guided Audio-Vertices Attention",
    TVCG 2025, Sec. III-D, Eq. 1.
    """
    _check(query, key, value, graph)
    scale = query.shape[-1] ** -0.5 if scale is None else scale
    backend = _choose(backend, query)
    if backend == "native":
        return attention_native(query.float(), key.float(), value.float(), graph, scale).to(query.dtype)
    return attention_reference(query, key, value, graph, scale)


def attention_maps(
    query: Float[Tensor, "batch tokens heads dim"],
    key: Float[Tensor, "batch tokens heads dim"],
    graph: MeshGraph,
    scale: float | None = None,
) -> AttentionMaps:
    """The maps that the paper shows, from the same queries and keys; not differentiated."""
    _check(query, key, key, graph)
    with torch.no_grad():
        scale = query.shape[-1] ** -0.5 if scale is None else scale
        probabilities, global_row = edge_probabilities(query, key, graph, scale)
        columns = graph.keys.long()[None, :, None].expand_as(probabilities)
        received = probabilities.new_zeros(len(query), graph.n_vertices, query.shape[2])
        received = received.scatter_reduce(1, columns, probabilities, "amax")
        return AttentionMaps(received, None if global_row is None else global_row[:, : graph.n_vertices])


def _choose(backend: str, query: Tensor) -> str:
    if backend not in BACKENDS:
        raise OptionError(f"backend {backend!r} is not one of {', '.join(BACKENDS)}")
    if backend == "auto":
        fast = query.device.type == "cpu" and query.dtype != torch.float64 and native.available()
        return "native" if fast else "reference"
    if backend == "native":
        if not native.available():
            raise BackendError(
                "backend 'native' is not built: install meshanim with a C++17 compiler at hand, "
                "or use backend='reference'"
            )
        if query.device.type != "cpu" or query.dtype == torch.float64:
            raise BackendError(
                f"backend 'native' computes float32 on the CPU, not {query.dtype} on {query.device}: "
                "use backend='reference'"
            )
    if backend == "cuda" and query.device.type != "cuda":
        raise BackendError(
            f"backend 'cuda' needs tensors on an NVIDIA GPU, not on {query.device}: use 'auto'"
        )
    return backend


def _check(query: Tensor, key: Tensor, value: Tensor, graph: MeshGraph) -> None:
    if query.ndim != 4 or query.shape != key.shape or key.shape != value.shape:
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in (query, key, value))
        raise ShapeError(
            f"query, key and value must share one shape (batch, tokens, heads, dim), not {shapes}"
        )
    if query.shape[1] != graph.n_tokens:
        raise ShapeError(
            f"the graph has {graph.n_tokens} tokens ({graph.n_vertices} vertices"
            f"{' and the global token' if graph.global_token else ''}), the queries {query.shape[1]}"
        )
    if query.device != graph.device:
        raise ShapeError(
            f"the graph is on {graph.device}, the queries on {query.device}: use graph.to(device)"
        )
