"""What every metric asks of its arrays, and how two clips of different length are made comparable."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from meshanim.errors import ShapeError

__all__ = ["check_finite", "checked_pair", "chosen", "truncated"]

Vertices = Float[Tensor, "frames vertices 3"]
Indices = Int[Tensor, " mask"]


def truncated(
    predicted: Float[Tensor, "frames *rest"], true: Float[Tensor, "true_frames *rest"]
) -> tuple[Float[Tensor, "kept *rest"], Float[Tensor, "kept *rest"], int]:
    """Both cut to the shorter one, and how many frames that drops.

    Every published script does this: predictions differ from the recordings by a frame or two
    (CodeTalker's cal_metric.py, FaceDiffuser's compute_objective_metrics.py).

    Parameters
    ----------
    predicted, true : (T, ...) and (T', ...)
        Frames first.
    """
    kept = min(len(predicted), len(true))
    return predicted[:kept], true[:kept], max(len(predicted), len(true)) - kept


def chosen(vertices: Vertices, mask: Indices | None) -> Float[Tensor, "frames mask 3"]:
    """The masked vertices, all of them without a mask.

    Raises
    ------
    ShapeError
        If there are no frames, the mask is empty or reaches past the mesh, or a chosen value is not finite.
    """
    if not len(vertices):
        raise ShapeError("there are no frames to measure")
    if mask is not None:
        if not len(mask):
            raise ShapeError("the mask names no vertices")
        if int(mask.min()) < 0 or int(mask.max()) >= vertices.shape[1]:
            raise ShapeError(
                f"the mask names vertex {int(mask.max() if mask.max() > 0 else mask.min())},"
                f" the mesh has {vertices.shape[1]}: the mask of another topology?"
            )
        vertices = vertices[:, mask]
    check_finite(vertices)
    return vertices


def checked_pair(
    predicted: Vertices, true: Float[Tensor, "true_frames true_vertices 3"], mask: Indices | None
) -> tuple[Float[Tensor, "frames mask 3"], Float[Tensor, "frames mask 3"]]:
    """`chosen` of two clips of the same shape; ShapeError otherwise."""
    if predicted.shape != true.shape:
        raise ShapeError(
            f"predicted {tuple(predicted.shape)} and true {tuple(true.shape)} differ:"
            " the same topology is needed, and both cut to the shorter one (`truncated`)"
        )
    return chosen(predicted, mask), chosen(true, mask)


def check_finite(values: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"]) -> None:
    """ShapeError if a value is NaN or infinite."""
    if not torch.isfinite(values).all():
        raise ShapeError("the values hold NaN or infinity")
