"""Which point of one head is which point of another, across topologies."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Int
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from meshanim.errors import MeshError, OptionError, ShapeError
from meshanim.geometry.alignment import Similarity, align
from meshanim.geometry.closest_points import barycentric_coordinates
from meshanim.geometry.deformation import DeformationTransfer
from meshanim.geometry.mesh import TriangleMesh
from meshanim.geometry.transfer import barycentric_operator, carry

__all__ = ["SurfaceCorrespondence", "agreeing_points", "surface_correspondence"]

CANDIDATES = 12
"""Faces nearest in place and direction among which the closest point is sought."""
NORMAL_WEIGHT = 0.1
"""Opposed normals count as this share of the head's radius apart."""
STIFFNESS = (0.5, 0.25, 0.12, 0.06, 0.03)
"""Lengths below which the registration stays smooth, as shares of the head's radius, coarse to fine."""
ROUNDS = 3
"""Closest-point searches and solves at each stiffness."""


@dataclass(frozen=True)
class SurfaceCorrespondence:
    """The point of a source surface that belongs to each vertex and face of a target mesh."""

    source: TriangleMesh
    target: TriangleMesh
    operator: sp.csr_array
    """(V_target, V_source): values of the source's vertices at the target's. Rows sum to one."""
    faces: np.ndarray
    """(F_target,) int: the source face that belongs to each target face."""
    distance: np.ndarray
    """(V_target,) float: how far each target vertex lies from the registered source, in metres of the
    target: small where both heads have the part, large where only the target does."""
    alignment: Similarity
    """From the source's coordinates to the target's."""
    registered: np.ndarray
    """(V_source, 3) float: the source deformed onto the target."""

    def carry(self, values: np.ndarray) -> np.ndarray:
        """Values (..., V_source, C) of the source, such as colours or weights, on the target's vertices."""
        return carry(self.operator, values)

    def carry_displacements(self, frames: np.ndarray) -> np.ndarray:
        """Frames (..., V_source, 3) of the source as frames of the target, by moving each vertex alike."""
        moves = carry(self.operator, frames - self.source.vertices.astype(frames.dtype))
        turn = self.alignment.scale * self.alignment.rotation
        return self.target.vertices.astype(moves.dtype) + moves @ turn.numpy().T.astype(moves.dtype)

    def deformation_transfer(self) -> DeformationTransfer:
        """The solver that gives the target the source's deformation gradients instead of its moves."""
        scale = float(self.alignment.scale)
        rotation = self.alignment.rotation.numpy()
        return DeformationTransfer(self.source, self.target, self.faces, rotation, scale)


def surface_correspondence(
    source: TriangleMesh, target: TriangleMesh, landmarks: Int[np.ndarray, "landmarks 2"] | None = None
) -> SurfaceCorrespondence:
    """Find corresponding points of two heads of any topology.

    The source is brought to the target by a similarity (of the landmarks; without them by scale and place
    only, from the boxes around both, then on closest points), then deformed onto it by non-rigid iterative
    closest points: displacements d minimise sum_i w_i m_i |x_i + d_i - c_i|² + s⁴ |M^(-1/2) L d|², with m
    the vertex areas, L the Laplacian, robust weights w and a smoothing length s that falls (after Amberg et
    al. 2007, with bending instead of local affine regularity). Where a head is smooth and round nothing
    holds points from sliding by some millimetres; a dozen landmarks do. Each target vertex then takes its
    closest point of the deformed source whose normal agrees, so that facing lips and lids stay apart.

    Parameters
    ----------
    source, target : TriangleMesh
        Heads in similar poses, every vertex in a face, the source without triangles of no area. Without
        landmarks both stand upright and face the same way.
    landmarks : (n, 2) int, optional
        Pairs of a source vertex and a target vertex that correspond, three or more; they are kept to.

    Raises
    ------
    OptionError
        If a landmark does not exist.
    ShapeError
        If there are one or two landmarks only.
    MeshError
        If a mesh has no faces or unused vertices, or the source triangles without area.
    """
    for name, mesh in (("source", source), ("target", target)):
        if not mesh.n_faces or len(mesh.unused_vertices):
            raise MeshError(
                f"{name}: correspondence needs every vertex in a face; {mesh!r} has "
                f"{len(mesh.unused_vertices)} outside: remove them with meshanim.geometry.repair"
            )
    if landmarks is None:
        landmarks = np.zeros((0, 2), np.int64)
    elif len(landmarks) < 3:
        raise ShapeError(f"landmarks must be three pairs or more, not {len(landmarks)}")
    elif landmarks.min() < 0 or (landmarks.max(0) >= [source.n_vertices, target.n_vertices]).any():
        raise OptionError(
            f"landmarks name source vertices up to {landmarks[:, 0].max()} of {source.n_vertices} and target "
            f"vertices up to {landmarks[:, 1].max()} of {target.n_vertices}"
        )
    alignment = _initial_alignment(source, target, landmarks)
    aligned = source.with_vertices(alignment.apply(torch.from_numpy(source.vertices)).numpy())
    registered = aligned.with_vertices(_register(aligned, target, landmarks))

    corners, weights, _, distance = agreeing_points(registered, target.vertices, target.vertex_normals)
    centres = target.vertices[target.faces].mean(1)
    *_, faces, _ = agreeing_points(registered, centres, target.face_normals)
    return SurfaceCorrespondence(
        source,
        target,
        barycentric_operator(corners, weights, source.n_vertices),
        faces,
        distance,
        alignment,
        registered.vertices,
    )


def _initial_alignment(source: TriangleMesh, target: TriangleMesh, landmarks: np.ndarray) -> Similarity:
    if len(landmarks):
        held, goals = source.vertices[landmarks[:, 0]], target.vertices[landmarks[:, 1]]
        return align(torch.from_numpy(held), torch.from_numpy(goals), scaling=True)
    points, areas = source.vertices, source.mass.diagonal()
    scale = _radius(target) / _radius(source)
    offset = (target.vertices.min(0) + target.vertices.max(0) - scale * (points.min(0) + points.max(0))) / 2
    # Rotation stays: on closest points alone it drifts by degrees along the round parts of a head.
    for _ in range(20):
        corners, weights, _, distance = agreeing_points(
            target, scale * points + offset, source.vertex_normals
        )
        closest = np.einsum("nk,nkd->nd", weights, target.vertices[corners])
        share = _robust_weights(distance) * areas
        share = (share / share.sum())[:, None]
        from_centre, to_centre = points - (share * points).sum(0), closest - (share * closest).sum(0)
        scale = float(np.sqrt((share * to_centre**2).sum() / (share * from_centre**2).sum()))
        offset = (share * (closest - scale * points)).sum(0)
    return Similarity(
        torch.eye(3, dtype=torch.float64), torch.from_numpy(offset), torch.tensor(scale).double()
    )


def _register(source: TriangleMesh, target: TriangleMesh, landmarks: np.ndarray) -> np.ndarray:
    """Positions of the aligned source's vertices after deforming it onto the target."""
    mass = source.mass.diagonal()
    bending = (source.laplacian @ sp.diags_array(1 / mass) @ source.laplacian).tocsc()
    border = _border_faces(target)
    anchored = np.zeros(source.n_vertices)
    np.add.at(anchored, landmarks[:, 0], 1.0)
    moves = np.zeros_like(source.vertices)
    for stiffness in STIFFNESS:
        smooth = (stiffness * _radius(target)) ** 4 * bending
        for _ in range(ROUNDS):
            current = source.with_vertices(source.vertices + moves)
            corners, weights, face, distance = agreeing_points(
                target, current.vertices, current.vertex_normals
            )
            closest = np.einsum("nk,nkd->nd", weights, target.vertices[corners])
            agrees = (current.vertex_normals * target.face_normals[face]).sum(1) > 0.5
            off_edge = ~(border[face] & (weights < 1e-6).any(1))
            # A little of everything, so that parts without partners stay rather than drift.
            data = mass * np.maximum(_robust_weights(distance) * agrees * off_edge, 1e-4)
            wanted = np.where((agrees & off_edge)[:, None], closest - source.vertices, moves)
            fixed = anchored * mass.sum()
            held = np.zeros_like(moves)
            np.add.at(
                held, landmarks[:, 0], target.vertices[landmarks[:, 1]] - source.vertices[landmarks[:, 0]]
            )
            system = (sp.diags_array(data + fixed) + smooth).tocsc()
            factor = splu(
                system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
            moves = factor.solve(data[:, None] * wanted + mass.sum() * held)
    return source.vertices + moves


def agreeing_points(
    mesh: TriangleMesh, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corners (n, 3), weights (n, 3), face and distance of the closest point whose normal agrees best."""
    weight = NORMAL_WEIGHT * _radius(mesh) / 2
    tree = cKDTree(np.hstack([mesh.vertices[mesh.faces].mean(1), weight * mesh.face_normals]))
    _, candidates = tree.query(np.hstack([points, weight * normals]), min(CANDIDATES, mesh.n_faces))
    candidates = candidates.reshape(len(points), -1)
    count = candidates.shape[1]
    corners = mesh.vertices[mesh.faces[candidates]].reshape(-1, 3, 3)
    weights = barycentric_coordinates(np.repeat(points, count, axis=0), corners)
    offset = np.einsum("nk,nkd->nd", weights, corners) - np.repeat(points, count, axis=0)
    square = (offset**2).sum(1).reshape(-1, count)
    turned = ((mesh.face_normals[candidates] - normals[:, None]) ** 2).sum(2)
    best = (square + weight**2 * turned).argmin(1)
    row = np.arange(len(points))
    face = candidates[row, best]
    return mesh.faces[face], weights.reshape(-1, count, 3)[row, best], face, np.sqrt(square[row, best])


def _robust_weights(distance: np.ndarray) -> np.ndarray:
    """Geman-McClure weights at twice the median distance."""
    scale = 2 * max(float(np.median(distance)), 1e-9)
    return 1 / (1 + (distance / scale) ** 2) ** 2


def _border_faces(mesh: TriangleMesh) -> np.ndarray:
    on_border = np.zeros(mesh.n_vertices, bool)
    on_border[mesh.boundary] = True
    return on_border[mesh.faces].sum(1) >= 2


def _radius(mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)) / 2)
