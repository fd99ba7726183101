"""Hair that falls over the ears: strands are pushed outwards until they clear a person's own ears."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from meshanim.render.look.strands import Strands, strand_points, triangle_frames

__all__ = ["clear_ears"]

MARGIN = 0.002
"""Metres that hair keeps from the hull of an ear."""
SPREAD = np.array([0.15, 0.35, 0.6, 0.85, 1.0, 0.95, 0.85, 0.75, 0.65, 0.55, 0.45])
"""Share of a point's push that its neighbours get, from four points before it to six points after."""
BEFORE = 4


def clear_ears(
    strands: Strands,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: np.ndarray,
    ears: Float[np.ndarray, " vertices"],
) -> Strands:
    """Strands that do not enter the convex hulls of the ears; the points around a pushed one follow it.

    What is pushed outwards comes to light: its occlusion lessens.

    Parameters
    ----------
    strands : Strands
    vertices : (N, 3) float32
        The person's resting skin surface, metres.
    faces : (F, 3) int
    ears : (N,) float32
        Mask in [0, 1] on the vertices.
    """
    points = strand_points(strands, vertices, faces).astype(float)
    hulls = [(side, ConvexHull(vertices[(ears > 0.3) & (side * vertices[:, 0] > 0)])) for side in (1.0, -1.0)]
    spread = _follow(np.sum([side * _exit_distance(points, hull, side) for side, hull in hulls], axis=0))
    # A point between the head and the ear may have followed its neighbours into the hull.
    points[..., 0] += spread
    spread += np.sum([side * _exit_distance(points, hull, side) for side, hull in hulls], axis=0)
    spread[:, 0] = 0
    corners = faces[strands.triangle]
    frames = triangle_frames(vertices, corners)
    offsets = strands.offsets + spread[:, 1:, None] * frames[:, None, 0, :]
    bared = 0.7 * np.minimum(np.abs(spread) / 0.010, 1) * np.clip(0.8 - strands.occlusion, 0, None)
    return replace(
        strands,
        offsets=np.ascontiguousarray(offsets, np.float32),
        occlusion=np.ascontiguousarray(strands.occlusion + bared, np.float32),
    )


def _follow(push: np.ndarray) -> np.ndarray:
    """The largest of a point's own push and its neighbours' shares (n, k), signed."""
    spread = np.zeros_like(push)
    for shift, share in enumerate(SPREAD, start=-BEFORE):
        moved = np.zeros_like(push)
        if shift < 0:
            moved[:, :shift] = push[:, -shift:]
        else:
            moved[:, shift:] = push[:, : push.shape[1] - shift]
        spread = np.where(np.abs(moved) * share > np.abs(spread), moved * share, spread)
    return spread


def _exit_distance(points: np.ndarray, hull: ConvexHull, side: float) -> np.ndarray:
    """How far sideways points have to go to leave the hull grown by `MARGIN`; 0 outside of it."""
    normal, offset = hull.equations[:, :3], hull.equations[:, 3]
    low, high = hull.points.min(0) - MARGIN, hull.points.max(0) + MARGIN
    near = ((points > low) & (points < high)).all(-1)
    depth = points[near] @ normal.T + offset - MARGIN
    inside = (depth < 0).all(1)
    facing = side * normal[:, 0]
    ahead = facing > 0.05
    distance = (-depth[:, ahead] / facing[ahead]).min(1)
    result = np.zeros(points.shape[:2])
    result[near] = np.where(inside, distance, 0)
    return result
