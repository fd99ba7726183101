"""Head motion as Audio2Face-3D generates it (Sec. 9.2): two joints of three angles, and a translation."""

import roma
import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["head_of_rotation", "head_rotation"]


def head_of_rotation(pose: Float[Tensor, "frames 3"]) -> Float[Tensor, "frames 9"]:
    """Head rotations about the neck joint, axis-angle, as neck angles; the other six numbers are zero.

    Angles are about the fixed axes x, then y, then z, radians.
    """
    angles = roma.rotvec_to_euler("xyz", pose.double()).to(pose)
    return torch.cat([angles, angles.new_zeros(len(pose), 6)], dim=1)


def head_rotation(motion: Float[Tensor, "frames 9"]) -> Float[Tensor, "frames 3"]:
    """Rotation of the head, the neck's after its own, axis-angle in radians: `MeshSequence.pose`."""
    neck, head = (roma.euler_to_rotmat("xyz", motion[:, k : k + 3].double()) for k in (0, 3))
    return roma.rotmat_to_rotvec(neck @ head).to(motion)
