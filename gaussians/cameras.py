"""`Cameras`: the pinhole cameras that Gaussians are seen by, as tensors that may carry gradients."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.errors import OptionError, ShapeError
from meshanim.render.camera import Camera

__all__ = ["Cameras"]


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras of one image size, OpenCV's way (x right, y down, z forward).

    Leading dimensions are a batch: world_to_camera (B, C, 4, 4) gives each of B frames C cameras of its own,
    (C, 4, 4) shows all frames to the same C.

    Parameters
    ----------
    world_to_camera : (..., C, 4, 4) float
        Rigid transforms from the world to camera space, metres. Gradients reach it.
    intrinsics : (..., C, 3, 3) float
        Pixels, without skew; pixel centres lie at half integers.
    width, height : int
        Image size in pixels.

    Raises
    ------
    ShapeError
        If a matrix has another shape or is not finite, or intrinsics have skew or no focal length.
    OptionError
        If a size is not positive.
    """

    world_to_camera: Float[Tensor, "*batch cameras 4 4"]
    intrinsics: Float[Tensor, "*#batch cameras 3 3"]
    width: int
    height: int

    def __post_init__(self):
        for name, size in (("world_to_camera", 4), ("intrinsics", 3)):
            matrix = getattr(self, name)
            if matrix.ndim < 3 or tuple(matrix.shape[-2:]) != (size, size):
                raise ShapeError(f"{name} must be (..., C, {size}, {size}), not {tuple(matrix.shape)}")
            if not bool(torch.isfinite(matrix.detach()).all()):
                raise ShapeError(f"{name} is not finite")
        if self.intrinsics.shape[-3] != self.world_to_camera.shape[-3]:
            raise ShapeError(
                f"{self.world_to_camera.shape[-3]} cameras have intrinsics of {self.intrinsics.shape[-3]}"
            )
        k = self.intrinsics.detach()
        if bool((k[..., 0, 1] != 0).any()) or not bool(((k[..., 0, 0] > 0) & (k[..., 1, 1] > 0)).all()):
            raise ShapeError("intrinsics must have positive focal lengths and no skew")
        if self.width < 1 or self.height < 1:
            raise OptionError(f"image size must be positive, not {self.width} x {self.height}")

    def __len__(self) -> int:
        """How many cameras a frame has."""
        return self.world_to_camera.shape[-3]

    def to(self, *device_or_dtype: torch.device | torch.dtype | str) -> "Cameras":
        """On another device or of another type."""
        world_to_camera, intrinsics = (
            matrix.to(*device_or_dtype)  # type: ignore[call-overload]
            for matrix in (self.world_to_camera, self.intrinsics)
        )
        if world_to_camera is self.world_to_camera and intrinsics is self.intrinsics:
            return self
        return Cameras(world_to_camera, intrinsics, self.width, self.height)

    @property
    def positions(self) -> Float[Tensor, "*batch cameras 3"]:
        """Where the cameras stand in the world, metres."""
        rotation, translation = self.world_to_camera[..., :3, :3], self.world_to_camera[..., :3, 3]
        return -(rotation.transpose(-1, -2) @ translation[..., None])[..., 0]

    def scaled(self, width: int, height: int) -> "Cameras":
        """The same views with another number of pixels."""
        factors = self.intrinsics.new_tensor([width / self.width, height / self.height, 1.0])
        return Cameras(self.world_to_camera, factors[:, None] * self.intrinsics, width, height)

    @classmethod
    def of(cls, cameras: Camera | Sequence[Camera], dtype: torch.dtype = torch.float32) -> "Cameras":
        """The mesh renderer's cameras, perspective and of one size.

        Raises
        ------
        OptionError
            If there is none, one is orthographic, or their sizes differ.
        """
        cameras = [cameras] if isinstance(cameras, Camera) else list(cameras)
        if not cameras or any(camera.orthographic for camera in cameras):
            raise OptionError("Gaussians are seen by one or more perspective cameras")
        sizes = {(camera.width, camera.height) for camera in cameras}
        if len(sizes) != 1:
            raise OptionError(f"cameras of one batch must have one image size, not {sorted(sizes)}")
        width, height = sizes.pop()
        matrices = (
            np.stack([getattr(c, name) for c in cameras]) for name in ("world_to_camera", "intrinsics")
        )
        world_to_camera, intrinsics = (torch.as_tensor(matrix, dtype=dtype) for matrix in matrices)
        return cls(world_to_camera, intrinsics, width, height)
