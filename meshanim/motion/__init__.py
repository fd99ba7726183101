"""Animated meshes and what is done to them."""

from meshanim.motion.sequence import MeshSequence

__all__ = ["MeshSequence"]
