"""Blendshapes of one head for another neutral face, of the same topology or of any other."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int

from meshanim.errors import OptionError
from meshanim.geometry import (
    DeformationTransfer,
    SurfaceCorrespondence,
    TriangleMesh,
    align,
    carry,
    surface_correspondence,
)
from meshanim.heads import Head, Rig

__all__ = ["Method", "personal_shapes"]

Method = Literal["displacement", "deformation_transfer"]
REACH = 0.15
"""Parts of the target that lie further from the source than this share of its radius (half the diagonal of
its bounding box), such as hair or a body, stay still; moves fade out from half of it on."""


def personal_shapes(
    source: Head,
    target: TriangleMesh,
    method: Method = "deformation_transfer",
    landmarks: Int[np.ndarray, "landmarks 2"] | None = None,
) -> Rig:
    """Give a neutral face the named shapes of a head (Audio2Face-3D, Sec. 6.3).

    Parameters
    ----------
    source : Head
        Whose expressions are wanted, such as the default head with ARKit's 52.
    target : TriangleMesh
        A face at rest, upright and facing along +z, in any unit. If it has the source's triangles, its
        vertices are the source's, one by one; else `surface_correspondence` finds which is which.
    method : str
        "deformation_transfer" gives each triangle the deformation of its counterpart (Sumner and Popovic
        2004): it fits faces of other proportions and stays smooth. "displacement" moves each vertex as its
        counterpart, at the target's size: exact between faces of one topology and similar proportions, but
        ragged at the lips where single vertices of another topology find the wrong lip.
    landmarks : (n, 2) int, optional
        Pairs of a source vertex and a target vertex that correspond, three or more.

    Returns
    -------
    Rig
        In the unit of the target, with the source's names and regions.

    Raises
    ------
    OptionError
        If there is no such method, the source has no expressions, or landmarks are given where the
        topologies agree.
    MeshError
        If a mesh is not fit for it, as `surface_correspondence` and `DeformationTransfer` say.
    """
    if method not in ("displacement", "deformation_transfer"):
        raise OptionError(f"no method {method!r}; there are displacement, deformation_transfer")
    if not source.expression_names:
        raise OptionError("the source head has no expressions to give")
    rest = source.mesh.vertices
    deltas = source.expression_directions.detach().cpu().unflatten(1, (-1, 3)).numpy().astype(np.float64)
    if source.mesh.n_vertices == target.n_vertices and np.array_equal(source.mesh.faces, target.faces):
        if landmarks is not None:
            raise OptionError("source and target share their triangles: landmarks say nothing here")
        moved = _same_topology(source.mesh, target, deltas, method)
        regions = dict(source.regions)
    else:
        found = surface_correspondence(source.mesh, target, landmarks)
        moved = _by_correspondence(found, rest + deltas, method)
        regions = {name: _carried(found, rows) for name, rows in source.regions.items()}
    return Rig(
        target.vertices, target.faces, source.expression_names, moved, target.uv, target.uv_faces, regions
    )


def _same_topology(
    source: TriangleMesh, target: TriangleMesh, deltas: np.ndarray, method: Method
) -> Float[np.ndarray, "shapes vertices 3"]:
    fit = align(torch.from_numpy(source.vertices), torch.from_numpy(target.vertices), scaling=True)
    turn, scale = fit.rotation.numpy(), float(fit.scale)
    if method == "displacement":
        return scale * deltas @ turn.T
    transfer = DeformationTransfer(source, target, rotation=turn, scale=scale)
    return transfer.solve(source.vertices + deltas) - target.vertices


def _by_correspondence(
    found: SurfaceCorrespondence, frames: np.ndarray, method: Method
) -> Float[np.ndarray, "shapes vertices 3"]:
    target = found.target
    reach = REACH * float(found.alignment.scale) * np.linalg.norm(np.ptp(found.source.vertices, axis=0)) / 2
    near = np.clip(2 - 2 * found.distance / reach, 0, 1)
    if method == "displacement":
        moved = found.carry_displacements(frames)
    else:
        still = (near[target.faces] == 0).all(1)
        faces = np.where(still, -1, found.faces)
        rotation, scale = found.alignment.rotation.numpy(), float(found.alignment.scale)
        moved = DeformationTransfer(found.source, target, faces, rotation, scale).solve(frames)
    return near[:, None] * (moved - target.vertices)


def _carried(found: SurfaceCorrespondence, rows: np.ndarray) -> Int[np.ndarray, " vertices"]:
    inside = np.zeros(found.source.n_vertices)
    inside[rows] = 1
    return np.flatnonzero(carry(found.operator, inside) > 0.5)
