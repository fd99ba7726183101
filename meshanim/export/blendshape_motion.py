"""`BlendshapeMotion`: a mesh, its named shapes, their weights over time, the head's turn."""

from dataclasses import dataclass

import numpy as np
import roma
import torch
from jaxtyping import Float, Float32

from meshanim.errors import ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.heads import Head
from meshanim.motion.blendshape_track import BlendshapeTrack

__all__ = ["BlendshapeMotion", "smooth_quaternions"]


@dataclass(frozen=True)
class BlendshapeMotion:
    """What a file with blendshape animation holds.

    Parameters
    ----------
    mesh : TriangleMesh
        The neutral face, metres.
    names : (E,) str
    deltas : (E, V, 3) float32
        What each shape adds at weight 1, metres.
    weights : (T, E) float32
    fps : float
    pose : (T, 3) float32
        Head rotation, axis-angle in radians.
    pivot : (3,) float
        The point the head turns about, metres.
    follow : (V,) float in [0, 1]
        How much of the rotation each vertex follows.
    """

    mesh: TriangleMesh
    names: tuple[str, ...]
    deltas: Float32[np.ndarray, "shapes vertices 3"]
    weights: Float32[np.ndarray, "frames shapes"]
    fps: float
    pose: Float32[np.ndarray, "frames 3"]
    pivot: Float[np.ndarray, " 3"]
    follow: Float[np.ndarray, " vertices"]

    @classmethod
    def of(
        cls,
        track: BlendshapeTrack,
        head: Head,
        neutral: Float[np.ndarray, "vertices 3"] | None = None,
        pivot: Float[np.ndarray, " 3"] | None = None,
    ) -> "BlendshapeMotion":
        """A track on a head: all shapes of the head, zero where the track has none of that name.

        Parameters
        ----------
        track : BlendshapeTrack
        head : Head
        neutral : (V, 3), optional
            Whose face moves, metres; the head's template if not given.
        pivot : (3,), optional
            Neck joint of that face, metres; the template's if not given.

        Raises
        ------
        OptionError
            If the head lacks a shape with a weight that is not zero.
        ShapeError
            If the neutral is of another number of vertices.
        """
        if neutral is not None and neutral.shape != (head.n_vertices, 3):
            raise ShapeError(f"neutral has shape {neutral.shape}, the head {head.n_vertices} vertices")
        weights = track.on(head)
        deltas = head.expression_directions.cpu().numpy().reshape(weights.shape[1], -1, 3)
        return cls(
            head.mesh if neutral is None else head.mesh.with_vertices(neutral),
            head.expression_names,
            deltas,
            weights,
            track.fps,
            np.asarray(track.pose, np.float32),
            head.joints()[0, 1].cpu().numpy() if pivot is None else pivot,
            head.weights[:, 1:].sum(1).cpu().numpy(),
        )


def smooth_quaternions(pose: Float[np.ndarray, "frames 3"]) -> Float32[np.ndarray, "frames 4"]:
    """Axis-angles as unit quaternions (x, y, z, w), each on the side of the one before it."""
    rotation = roma.rotvec_to_unitquat(torch.from_numpy(np.asarray(pose, np.float32))).numpy()
    flip = np.cumprod(np.sign(np.r_[1.0, (rotation[1:] * rotation[:-1]).sum(1)]) + 0.0)
    return rotation * np.where(flip == 0, 1, flip)[:, None].astype(np.float32)
