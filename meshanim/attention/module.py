"""`MeshAttention`: sparse mesh attention as a layer."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from meshanim.attention.functional import BACKENDS, AttentionMaps, attention_maps, mesh_attention
from meshanim.attention.graph import MeshGraph
from meshanim.errors import OptionError, ShapeError

__all__ = ["MeshAttention"]


class MeshAttention(nn.Module):
    """Multi-head attention over mesh neighbours with one fused projection in and one out (GAVA, Eq. 1).

    Parameters
    ----------
    width : int
        Features a token; a multiple of `heads`.
    heads : int
        Attention heads.
    dropout : float
        Probability of dropping an output feature while training. Not a dropout of attention weights, which a
        vertex with seven neighbours has too few of.
    bias : bool
        Whether the projections have a bias.
    backend : str
        As in `mesh_attention`.
    """

    def __init__(
        self, width: int, heads: int = 4, dropout: float = 0.0, bias: bool = True, backend: str = "auto"
    ):
        super().__init__()
        if width % heads:
            raise OptionError(f"width {width} is not a multiple of {heads} heads")
        if backend not in BACKENDS:
            raise OptionError(f"backend {backend!r} is not one of {', '.join(BACKENDS)}")
        self.heads = heads
        self.backend = backend
        self.project_in = nn.Linear(width, 3 * width, bias=bias)
        self.project_out = nn.Linear(width, width, bias=bias)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, tokens: Float[Tensor, "batch tokens width"], graph: MeshGraph
    ) -> Float[Tensor, "batch tokens width"]:
        """Attend within `graph`; the global token, where there is one, is the last of `tokens`."""
        query, key, value = self._project(tokens)
        attended = mesh_attention(query, key, value, graph, self.backend)
        return self.dropout(self.project_out(attended.flatten(2)))

    @torch.no_grad()
    def maps(self, tokens: Float[Tensor, "batch tokens width"], graph: MeshGraph) -> AttentionMaps:
        """The attention maps of this layer for the same `tokens`."""
        query, key, _ = self._project(tokens)
        return attention_maps(query, key, graph)

    def _project(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        width = self.project_out.in_features
        if tokens.shape[-1] != width:
            raise ShapeError(f"tokens must have {width} features, not {tokens.shape[-1]}")
        fused = self.project_in(tokens).unflatten(-1, (3, self.heads, width // self.heads))
        query, key, value = fused.unbind(2)
        return query, key, value
