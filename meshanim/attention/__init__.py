"""Sparse attention over mesh adjacency."""

from meshanim.attention.functional import AttentionMaps, attention_maps, mesh_attention
from meshanim.attention.graph import MeshGraph
from meshanim.attention.module import MeshAttention

__all__ = ["AttentionMaps", "MeshAttention", "MeshGraph", "attention_maps", "mesh_attention"]
