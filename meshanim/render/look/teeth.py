"""Teeth: twelve crowns and the gum of each jaw, swept along the arch of the head's own teeth strip."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from meshanim.render.look.eyes import similarity

__all__ = ["Teeth", "pose_teeth"]


@dataclass(frozen=True)
class Teeth:
    """One jaw of one person.

    Parameters
    ----------
    jaw : str
        `upper` or `lower`.
    vertices : (n, 3) float32
        At rest, metres.
    faces : (f, 3) int32
    uv : (n, 2) float32
        Into `texture`; v points up.
    texture : (H, W, 4) float32
        Linear albedo and roughness.
    anchors : (m,) int64
        The head's vertices that carry this jaw.
    rest : (m, 3) float32
        Their positions on the person's resting head.
    """

    jaw: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "vertices 2"]
    texture: Float[np.ndarray, "height width 4"]
    anchors: Int[np.ndarray, " anchors"]
    rest: Float[np.ndarray, "anchors 3"]


def pose_teeth(
    teeth: Teeth, head_vertices: Float[np.ndarray, "head_vertices 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Teeth on a moved head: the rigid motion (and scale) of their anchors."""
    scale, rotation, translation = similarity(teeth.rest, np.asarray(head_vertices)[teeth.anchors])
    return (scale * teeth.vertices @ rotation.T + translation).astype(np.float32)
