"""Closest points of a surface."""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import MeshError, ShapeError
from meshanim.geometry.mesh import TriangleMesh

__all__ = ["SurfacePoints", "barycentric_coordinates", "closest_points"]


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a mesh: a face and weights of its corners each, and how far from them the queries lay."""

    face: Int[np.ndarray, " points"]
    barycentric: Float[np.ndarray, "points 3"]
    """Not negative, each row sums to one."""
    position: Float[np.ndarray, "points 3"]
    """Metres."""
    distance: Float[np.ndarray, " points"]
    """Metres, not negative."""


def closest_points(mesh: TriangleMesh, points: Float[np.ndarray, "points 3"]) -> SurfacePoints:
    """Find the point of the surface that is closest to each of some points.

    Vertices that no face names are not part of the surface; triangles without area are, as segments.

    Parameters
    ----------
    mesh : TriangleMesh
        The surface.
    points : (n, 3) float
        Metres.

    Raises
    ------
    MeshError
        If the mesh has no faces.
    ShapeError
        If a point is NaN or infinite.
    """
    if not mesh.n_faces:
        raise MeshError(f"{mesh!r} has no faces, so no point of it is closest")
    if not np.isfinite(points).all():
        raise ShapeError("points: some are NaN or infinite")
    queries = np.ascontiguousarray(points, np.float64)
    if not len(queries):
        empty = np.zeros((0, 3))
        return SurfacePoints(np.zeros(0, np.int64), empty, empty, np.zeros(0))
    squared, face, _ = igl.point_mesh_squared_distance(queries, mesh.vertices, mesh.faces)
    corners = mesh.vertices[mesh.faces[face]]
    weights = barycentric_coordinates(queries, corners)
    return SurfacePoints(
        face.astype(np.int64),
        weights,
        np.einsum("nk,nkd->nd", weights, corners),
        np.sqrt(np.maximum(squared, 0.0)),
    )


def barycentric_coordinates(
    points: Float[np.ndarray, "points 3"], corners: Float[np.ndarray, "points 3 3"]
) -> Float[np.ndarray, "points 3"]:
    """Weights of the point of each triangle that is closest to each point.

    Where the foot of the perpendicular lies inside the triangle these are its barycentric coordinates, else
    those of the closest point of the closest side. Defined for triangles that are segments or points.
    """
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, 0]
    normal = np.cross(side, other)
    square = (normal**2).sum(1)
    longest = np.maximum((side**2).sum(1), (other**2).sum(1))
    solid = square > 1e-24 * longest**2
    safe = np.where(solid, square, 1.0)
    second = (np.cross(offset, other) * normal).sum(1) / safe
    third = (np.cross(side, offset) * normal).sum(1) / safe
    weights = np.stack([1 - second - third, second, third], axis=1)
    outside = np.flatnonzero(~solid | (weights < 0).any(1))
    weights[outside] = _closest_on_sides(points[outside], corners[outside])
    return weights


def _closest_on_sides(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    start, end = corners, np.roll(corners, -1, axis=1)
    along = end - start
    length = (along**2).sum(2)
    t = ((points[:, None] - start) * along).sum(2) / np.where(length > 0, length, 1.0)
    t = np.clip(t, 0.0, 1.0)
    distance = ((start + t[:, :, None] * along - points[:, None]) ** 2).sum(2)
    best = distance.argmin(1)
    row = np.arange(len(points))
    weights = np.zeros((len(points), 3))
    weights[row, best] = 1 - t[row, best]
    weights[row, (best + 1) % 3] = t[row, best]
    return weights
