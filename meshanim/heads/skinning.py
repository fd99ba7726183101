"""Linear blend skinning, shared by every head."""

from collections.abc import Sequence

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import ShapeError

__all__ = ["joint_transforms", "linear_blend_skinning"]


def joint_transforms(
    joints: Float[Tensor, "*batch joints 3"],
    rotations: Float[Tensor, "*batch joints 3 3"],
    parents: Sequence[int],
) -> tuple[Float[Tensor, "*batch joints 3 3"], Float[Tensor, "*batch joints 3"]]:
    """Rotation and translation that carry rest points along with each joint.

    Joint j turns by its own rotation about its rest position, then follows its parent (forward kinematics;
    Loper et al. 2015, SMPL, Eq. 3 and 4, with the rest pose already taken out).

    Parameters
    ----------
    joints : (..., J, 3)
        Rest positions, metres.
    rotations : (..., J, 3, 3)
        Rotation of each joint relative to its parent.
    parents : sequence of J int
        Parent of each joint, before it in the list; -1 for the root.

    Returns
    -------
    rotations : (..., J, 3, 3)
        In world axes.
    translations : (..., J, 3)
        A rest point p carried by joint j lies at `rotations[j] @ p + translations[j]`.

    Raises
    ------
    ShapeError
        If a joint comes before its parent, or the counts differ.
    """
    if len(parents) != joints.shape[-2] or len(parents) != rotations.shape[-3]:
        raise ShapeError(
            f"{len(parents)} parents, {joints.shape[-2]} joints and {rotations.shape[-3]} rotations "
            "are given: the three must agree"
        )
    world: list[Tensor] = []
    shift: list[Tensor] = []
    for index, parent in enumerate(parents):
        if parent >= index:
            raise ShapeError(f"joint {index} has parent {parent}: parents must come before their children")
        rotation, joint = rotations[..., index, :, :], joints[..., index, :]
        # p -> R (p - joint) + joint, then the parent's motion.
        move = joint - _apply(rotation, joint)
        if parent >= 0:
            rotation, move = world[parent] @ rotation, _apply(world[parent], move) + shift[parent]
        world.append(rotation)
        shift.append(move)
    return torch.stack(world, dim=-3), torch.stack(shift, dim=-2)


def linear_blend_skinning(
    vertices: Float[Tensor, "*batch vertices 3"],
    joints: Float[Tensor, "*batch joints 3"],
    rotation_vectors: Float[Tensor, "*batch joints 3"],
    parents: Sequence[int],
    weights: Float[Tensor, "vertices joints"],
) -> Float[Tensor, "*batch vertices 3"]:
    """Turn joints and let every vertex follow the weighted mean of their motions.

    v' = sum_j w_j (R_j v + t_j) (Loper et al. 2015, SMPL, Eq. 7); differentiable in all but `parents`.

    Parameters
    ----------
    vertices : (..., V, 3)
        Rest vertices, metres, any pose correctives already added.
    joints : (..., J, 3)
        Rest joints, metres.
    rotation_vectors : (..., J, 3)
        Axis-angle rotation of each joint relative to its parent, radians.
    parents : sequence of J int
        Parent of each joint; -1 for the root.
    weights : (V, J)
        Skinning weights; each row sums to 1.

    Returns
    -------
    (..., V, 3)
        Metres.
    """
    rotations, translations = joint_transforms(joints, roma.rotvec_to_rotmat(rotation_vectors), parents)
    motion = torch.cat([rotations.flatten(-2), translations], dim=-1)
    blended = weights @ motion
    turned = (blended[..., :9].unflatten(-1, (3, 3)) @ vertices[..., None])[..., 0]
    return turned + blended[..., 9:]


def _apply(rotation: Tensor, point: Tensor) -> Tensor:
    return (rotation @ point[..., None])[..., 0]
