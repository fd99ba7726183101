"""`Strands`: hair as polylines that ride on the triangles of the skin."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

__all__ = ["Strands", "attach", "strand_points", "triangle_frames"]


@dataclass(frozen=True)
class Strands:
    """n hairs of one kind, each a polyline of k + 1 points from its root, 16 at most.

    Everything is stored in the frame of the triangle that carries the root (`triangle_frames`), so strands
    follow identity, expression and pose: point j of a strand is root + frame @ offsets[j - 1].

    Parameters
    ----------
    kind : str
        `hair`, `brow`, `beard` or `lash`.
    triangle : (n,) int32
        Triangle of the skin surface.
    barycentric : (n, 3) float32
    offsets : (n, k, 3) float32
        From the root, metres.
    normals : (n, k + 1, 3) float32
        Outward direction of the hair's volume at each point, for wrapped diffuse light.
    occlusion : (n, k + 1) float32
        Share of light that reaches each point past the other strands, in [0, 1].
    width : (n,) float32
        Metres at the root; strands taper to a quarter at the tip.
    color : (n, 3) float32
        Linear albedo.
    """

    kind: str
    triangle: Int[np.ndarray, " strands"]
    barycentric: Float[np.ndarray, "strands 3"]
    offsets: Float[np.ndarray, "strands points 3"]
    normals: Float[np.ndarray, "strands points_and_root 3"]
    occlusion: Float[np.ndarray, "strands points_and_root"]
    width: Float[np.ndarray, " strands"]
    color: Float[np.ndarray, "strands 3"]

    def __len__(self) -> int:
        return len(self.triangle)


def triangle_frames(
    vertices: Float[np.ndarray, "vertices 3"], corners: Int[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """Orthonormal frames of triangles; columns: first edge, normal x first edge, normal."""
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    edge = b - a
    edge /= np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    normal = np.cross(edge, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.stack([edge, np.cross(normal, edge), normal], axis=2)


def strand_points(
    strands: Strands, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "strands points_and_root 3"]:
    """Points of every strand on the posed skin surface, root first."""
    corners = faces[strands.triangle]
    root = np.einsum("nkd,nk->nd", vertices[corners], strands.barycentric)
    bent = np.einsum("nij,nkj->nki", triangle_frames(vertices, corners), strands.offsets)
    return np.concatenate([root[:, None], root[:, None] + bent], axis=1)


def attach(
    kind: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    triangle: np.ndarray,
    barycentric: np.ndarray,
    offsets: np.ndarray,
    normals: np.ndarray,
    occlusion: np.ndarray,
    width: np.ndarray,
    color: np.ndarray,
) -> Strands:
    """Strands from offsets (n, k, 3) and normals (n, k + 1, 3) in space, at the pose of `vertices`."""
    frames = triangle_frames(vertices, faces[triangle])
    return Strands(
        kind,
        np.ascontiguousarray(triangle, np.int32),
        np.ascontiguousarray(barycentric, np.float32),
        np.einsum("nji,nkj->nki", frames, offsets).astype(np.float32),
        np.einsum("nji,nkj->nki", frames, normals).astype(np.float32),
        np.ascontiguousarray(occlusion, np.float32),
        np.ascontiguousarray(width, np.float32),
        np.ascontiguousarray(color, np.float32),
    )
