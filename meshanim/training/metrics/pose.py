"""Error of the head pose."""

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import ShapeError
from meshanim.training.metrics.checks import check_finite

__all__ = ["pose_error", "pose_errors"]


def pose_errors(
    predicted: Float[Tensor, "frames 3"], true: Float[Tensor, "true_frames 3"]
) -> Float[Tensor, " frames"]:
    """Angle of the rotation that takes one head pose to the other, each frame, 0 to pi radians.

    Parameters
    ----------
    predicted, true : (T, 3)
        Axis-angle, radians.

    Raises
    ------
    ShapeError
        If the tracks differ in length, are empty or hold NaN.
    """
    if predicted.shape != true.shape or not len(true):
        raise ShapeError(
            f"{len(predicted)} and {len(true)} poses: cut both to the shorter one (`truncated`), not empty"
        )
    check_finite(predicted)
    check_finite(true)
    apart = roma.quat_product(
        roma.quat_conjugation(roma.rotvec_to_unitquat(predicted)), roma.rotvec_to_unitquat(true)
    )
    return 2 * torch.atan2(apart[:, :3].norm(dim=-1), apart[:, 3].abs())


def pose_error(
    predicted: Float[Tensor, "frames 3"], true: Float[Tensor, "true_frames 3"]
) -> Float[Tensor, ""]:
    """Mean over frames of `pose_errors`, radians; tables print degrees."""
    return pose_errors(predicted, true).mean()
