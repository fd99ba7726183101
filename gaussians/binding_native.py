"""Local to world in C++, frames of the triangles included, as a torch operator."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int, Int32
from torch import Tensor

from meshanim.operators import cpu_operator, once_differentiable

try:
    from meshanim import _native
except ImportError:  # the extension is optional; `available` says so and to_world raises BackendError
    _native = None

__all__ = ["BindingLists", "available", "to_world_native"]


class BindingLists(NamedTuple):
    """A mesh and the Gaussians on it as the kernels read them."""

    corners: Int32[Tensor, "faces 3"]
    face: Int32[Tensor, " n"]
    face_offsets: Int32[Tensor, " faces_and_one"]
    """Where each triangle's Gaussians begin in `face_gaussians`."""
    face_gaussians: Int32[Tensor, " n"]
    vertex_offsets: Int32[Tensor, " vertices_and_one"]
    """Where each vertex's corners begin in `vertex_corners`."""
    vertex_corners: Int32[Tensor, " corners"]
    """3 * triangle + corner."""

    @classmethod
    def of(
        cls, faces: Int[np.ndarray, "faces 3"], n_vertices: int, face: Int[Tensor, " n"]
    ) -> "BindingLists":
        """Sort Gaussians by triangle and corners by vertex, each list ascending."""
        owners = face.numpy()
        lists = (*_lists(owners, len(faces)), *_lists(faces.ravel(), n_vertices))
        return cls(*(torch.from_numpy(array.astype(np.int32)) for array in (faces, owners, *lists)))


def _lists(owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    ends = np.cumsum(np.bincount(owner, minlength=count))
    return np.concatenate([[0], ends]), np.argsort(owner, kind="stable")


def available() -> bool:
    """Whether the extension was built."""
    return _native is not None


def to_world_native(
    vertices: Float32[Tensor, "frames vertices 3"],
    means: Float32[Tensor, "#frames n 3"],
    quaternions: Float32[Tensor, "#frames n 4"],
    scales: Float32[Tensor, "#frames n 3"],
    lists: BindingLists,
) -> tuple[Float32[Tensor, "frames n 3"], Float32[Tensor, "frames n 4"], Float32[Tensor, "frames n 3"]]:
    """Means, quaternions and scales in the world; local fields of one frame are shared by all.

    On the CPU. A triangle without area hands its vertices the gradients of positions only.
    """
    fields = (field.contiguous() for field in (vertices, means, quaternions, scales))
    world_means, world_quaternions, world_scales, _ = _forward(*fields, *lists)
    return world_means, world_quaternions, world_scales


@cpu_operator("bind_gaussians")
def _forward(
    vertices: Tensor,
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    corners: Tensor,
    face: Tensor,
    face_offsets: Tensor,
    face_gaussians: Tensor,
    vertex_offsets: Tensor,
    vertex_corners: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    world = [_empty(shape) for shape in _shapes(vertices, corners, face)]
    *fields, triangles = world
    given = (tensor.detach() for tensor in (means, quaternions, scales))
    _native.binding_forward(
        vertices.detach(), corners, face, *given, torch.get_num_threads(), triangles, *fields
    )
    return world[0], world[1], world[2], world[3]


def _shapes(vertices: Tensor, corners: Tensor, face: Tensor) -> list[torch.Size]:
    frames, count = vertices.shape[0], face.shape[0]
    return [torch.Size((frames, count, width)) for width in (3, 4, 3)] + [
        torch.Size((frames, corners.shape[0], 8))
    ]


def _empty(shape: torch.Size) -> Tensor:
    # As the outputs of attention: large blocks keep their pages from step to step.
    return _native.empty(shape) if shape.numel() >= 1 << 18 else torch.empty(shape, dtype=torch.float32)


@torch.library.register_fake(_forward)
def _(vertices, means, quaternions, scales, corners, face, f_offsets, f_gaussians, v_offsets, v_corners):
    shapes = _shapes(vertices, corners, face)
    return tuple(vertices.new_empty(shape) for shape in shapes)


@cpu_operator("bind_gaussians_backward")
def _backward(
    vertices: Tensor,
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    corners: Tensor,
    face: Tensor,
    face_offsets: Tensor,
    face_gaussians: Tensor,
    vertex_offsets: Tensor,
    vertex_corners: Tensor,
    triangles: Tensor,
    grad_means: Tensor,
    grad_quaternions: Tensor,
    grad_scales: Tensor,
    to_vertices: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    grad_vertices = _empty(vertices.shape) if to_vertices else vertices.new_empty(0, 0, 3)
    grads = (_empty(means.shape), _empty(quaternions.shape), _empty(scales.shape))
    scratch = _empty(torch.Size((4 * len(face) + 9 * len(corners) if to_vertices else 0,)))
    given = (tensor.detach() for tensor in (means, quaternions, scales, triangles))
    arriving = (tensor.detach().contiguous() for tensor in (grad_means, grad_quaternions, grad_scales))
    _native.binding_backward(
        vertices.detach(),
        corners,
        face,
        face_offsets,
        face_gaussians,
        vertex_offsets,
        vertex_corners,
        *given,
        *arriving,
        torch.get_num_threads(),
        *grads,
        grad_vertices,
        scratch,
    )
    return grad_vertices, *grads


@torch.library.register_fake(_backward)
def _(vertices, means, quaternions, scales, *others):
    grad_vertices = vertices.new_empty(vertices.shape if others[-1] else (0, 0, 3))
    return grad_vertices, *(tensor.new_empty(tensor.shape) for tensor in (means, quaternions, scales))


def _setup(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs, output[3])
    ctx.set_materialize_grads(False)  # zeros for output[3], which nobody differentiates


def _differentiate(
    ctx, grad_means: Tensor | None, grad_quaternions: Tensor | None, grad_scales: Tensor | None, _
):
    to_vertices, (vertices, means, quaternions, scales, *_) = ctx.needs_input_grad[0], ctx.saved_tensors
    arriving = [
        field.new_zeros(len(vertices), *field.shape[1:]) if grad is None else grad
        for field, grad in ((means, grad_means), (quaternions, grad_quaternions), (scales, grad_scales))
    ]
    grad_vertices, *grads = _backward(*ctx.saved_tensors, *arriving, to_vertices)
    return grad_vertices if to_vertices else None, *grads, *(None,) * 6


torch.library.register_autograd(_forward, _differentiate, setup_context=_setup)
once_differentiable(_backward)
