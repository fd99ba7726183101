"""Deformation gradients, and carrying the deformation of one surface over to another."""

from collections.abc import Iterator

import igl
import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu
from torch import Tensor

from meshanim.errors import MeshError, ShapeError
from meshanim.geometry.laplacian import zero_area_faces
from meshanim.geometry.mesh import TriangleMesh

__all__ = ["DeformationTransfer", "deformation_gradients"]

FRAMES_AT_ONCE = 64


def deformation_gradients(
    rest: Float[Tensor, "vertices 3"],
    deformed: Float[Tensor, "*batch vertices 3"],
    faces: Int[Tensor, "faces 3"],
) -> Float[Tensor, "*batch faces 3 3"]:
    """Linear part of the map of each triangle from rest to a deformed mesh.

    The direction across the triangle is that of its normal, stretched by the square root of the change in
    area (Sumner and Popovic 2004, Eq. 1 to 4): a similarity of scale s gives s times its rotation. Where
    a deformed triangle has no area the normal maps to zero. Differentiable in `deformed`.

    Raises
    ------
    MeshError
        If a triangle at rest has no area.
    """
    flat = zero_area_faces(rest.detach().cpu().double().numpy(), faces.cpu().numpy())
    if len(flat):
        raise MeshError(f"{len(flat)} triangles at rest have no area, the first is face {flat[0]}")
    return _edge_matrices(deformed, faces) @ torch.linalg.inv(_edge_matrices(rest, faces))


def _edge_matrices(vertices: Tensor, faces: Tensor) -> Tensor:
    """Columns: two sides and the normal times the square root of twice the area."""
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    normal = torch.linalg.cross(b - a, c - a)
    square = (normal * normal).sum(-1, keepdim=True)
    solid = square > torch.finfo(vertices.dtype).tiny
    scaled = torch.where(solid, normal * torch.where(solid, square, 1.0) ** -0.25, 0.0)
    return torch.stack([b - a, c - a, scaled], dim=-1)


class DeformationTransfer:
    """Give a target mesh the deformations of a source mesh; factorised once, solved for many frames.

    After Sumner and Popovic (2004). The target's vertices are those whose gradients differ least, weighted
    by area, from the source's deformation gradients; as the normal direction of a triangle is free in that
    problem, it is the Poisson problem of the target's cotangent Laplacian (Botsch et al. 2006). Gradients
    say nothing of position: each connected component is placed so that its centre moves as the centre of
    its counterpart does.

    Parameters
    ----------
    source, target : TriangleMesh
        Both at rest, without triangles of no area; every vertex of the target in a face.
    correspondence : (F_target,) int, optional
        The source face that each target face follows, -1 for target faces that keep their shape. By
        default the meshes share their faces. `surface_correspondence(source, target).faces` finds it.
    rotation : (3, 3) float, optional
        Turns directions of the source to those of the target, if they are at rest in different poses.
    scale : float
        Size of the target over that of the source; only moves of whole components depend on it.

    Raises
    ------
    ShapeError
        If the correspondence has not one entry a target face.
    MeshError
        If it names a source face that does not exist, or a mesh is degenerate.
    """

    def __init__(
        self,
        source: TriangleMesh,
        target: TriangleMesh,
        correspondence: Int[np.ndarray, " faces"] | None = None,
        rotation: Float[np.ndarray, "3 3"] | None = None,
        scale: float = 1.0,
    ):
        if correspondence is None:
            if source.n_faces != target.n_faces:
                raise ShapeError(
                    f"source has {source.n_faces} faces, target {target.n_faces}: give the correspondence"
                )
            correspondence = np.arange(target.n_faces)
        if len(correspondence) != target.n_faces:
            raise ShapeError(f"correspondence has {len(correspondence)} entries for {target.n_faces} faces")
        if correspondence.min(initial=0) < -1 or correspondence.max(initial=-1) >= source.n_faces:
            raise MeshError(
                f"correspondence names source faces {correspondence.min()}..{correspondence.max()}, but "
                f"there are {source.n_faces} (-1 for none)"
            )
        for name, mesh in (("source", source), ("target", target)):
            if len(mesh.degenerate_faces):
                raise MeshError(
                    f"{name}: {len(mesh.degenerate_faces)} triangles have no area, the first is face "
                    f"{mesh.degenerate_faces[0]}; remove them with meshanim.geometry.repair"
                )
        if len(target.unused_vertices):
            raise MeshError(f"target: {len(target.unused_vertices)} vertices belong to no face")
        self.source, self.target, self.correspondence = source, target, correspondence
        self.rotation = np.eye(3) if rotation is None else rotation
        self.scale = scale

        gradient = sp.csr_array(igl.grad(target.vertices, target.faces))
        self._divergence = (gradient.T @ sp.diags_array(np.tile(target.face_areas, 3))).tocsr()
        stiffness = (self._divergence @ gradient).tocsc()
        _, pinned = np.unique(target.components, return_index=True)
        self._free = np.setdiff1d(np.arange(target.n_vertices), pinned)
        self._factor = splu(
            stiffness[self._free][:, self._free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        self._centring = self._centring_matrix(np.ones(target.n_faces, bool))
        self._matched_centring = self._centring_matrix(correspondence >= 0)

    def solve(self, frames: Float[np.ndarray, "*frames vertices 3"]) -> Float[np.ndarray, "*frames target 3"]:
        """The target's vertices for each frame of the source, in metres.

        Raises
        ------
        ShapeError
            If the frames are not of the source's vertices.
        """
        if frames.shape[-2] != self.source.n_vertices:
            raise ShapeError(f"frames have {frames.shape[-2]} vertices, the source {self.source.n_vertices}")
        flat = frames.reshape(-1, self.source.n_vertices, 3)
        solved = np.concatenate([np.zeros((0, self.target.n_vertices, 3)), *self._chunks(flat)])
        dtype = np.result_type(frames.dtype, np.float32)
        return solved.reshape(*frames.shape[:-2], self.target.n_vertices, 3).astype(dtype, copy=False)

    def _chunks(self, frames: np.ndarray) -> Iterator[np.ndarray]:
        follows = self.correspondence >= 0
        counterpart = self.source.faces[self.correspondence[follows]]
        rest = torch.from_numpy(self.source.vertices)
        used, index = np.unique(self.correspondence[follows], return_inverse=True)
        used_faces = torch.from_numpy(self.source.faces[used])
        for start in range(0, len(frames), FRAMES_AT_ONCE):
            chunk = frames[start : start + FRAMES_AT_ONCE].astype(np.float64)
            count = len(chunk)
            gradients = np.tile(np.eye(3), (count, self.target.n_faces, 1, 1))
            found = deformation_gradients(rest, torch.from_numpy(chunk), used_faces).numpy()
            gradients[:, follows] = (self.rotation @ found @ self.rotation.T)[:, index]
            # igl stacks the x, y and z derivatives of all faces; columns are coordinates of frames.
            wanted = gradients.transpose(3, 1, 0, 2).reshape(3 * self.target.n_faces, count * 3)
            columns = np.zeros((self.target.n_vertices, count * 3))
            columns[self._free] = self._factor.solve((self._divergence @ wanted)[self._free])
            positions = columns.reshape(-1, count, 3).transpose(1, 0, 2)

            moves = np.zeros((count, self.target.n_faces, 3))
            centres = chunk[:, counterpart].mean(2) - self.source.vertices[counterpart].mean(1)
            moves[:, follows] = self.scale * centres @ self.rotation.T
            rest_centre = self._centring @ self.target.vertices[self.target.faces].mean(1)
            wanted_centre = rest_centre + self._matched_centring @ moves
            centre = self._centring @ positions[:, self.target.faces].mean(2)
            yield positions + (wanted_centre - centre)[:, self.target.components]

    def _centring_matrix(self, faces: np.ndarray) -> np.ndarray:
        """(components, F) matrix that averages over the area of the given faces of each component."""
        component = self.target.components[self.target.faces[:, 0]]
        matrix = np.zeros((self.target.n_components, self.target.n_faces))
        matrix[component, np.arange(self.target.n_faces)] = self.target.face_areas * faces
        return matrix / np.maximum(matrix.sum(1, keepdims=True), np.finfo(float).tiny)
