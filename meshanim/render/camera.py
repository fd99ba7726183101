"""`Camera`: OpenCV conventions (x right, y down, z forward), pixel centres at half integers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError, ShapeError

__all__ = ["Camera", "look_at", "orthographic_camera", "portrait_camera"]

Point = Sequence[float | int] | np.ndarray


@dataclass(frozen=True)
class Camera:
    """One camera.

    Parameters
    ----------
    world_to_camera : (4, 4) float
        Rigid transform from world to camera space, metres.
    intrinsics : (3, 3) float
        Pixels: a point (x, y, z) in camera space is seen at `intrinsics @ (x, y, z) / z`; for an
        orthographic camera at `intrinsics @ (x, y, 1)`, so that the focal lengths are pixels a metre.
    width, height : int
        Image size in pixels.
    near : float
        Distance of the near plane in metres.
    orthographic : bool
        Parallel projection, for shadow maps and texture space.

    Raises
    ------
    ShapeError
        If a matrix has another shape or is not finite.
    OptionError
        If a size is not positive, or `near` is not in a perspective camera.
    """

    world_to_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    width: int
    height: int
    near: float = 0.01
    orthographic: bool = False

    def __post_init__(self):
        for name, size in (("world_to_camera", 4), ("intrinsics", 3)):
            matrix = np.ascontiguousarray(getattr(self, name), np.float64)
            if matrix.shape != (size, size) or not np.isfinite(matrix).all():
                raise ShapeError(f"{name} must be a finite ({size}, {size}) matrix, not {matrix.shape}")
            object.__setattr__(self, name, matrix)
        if self.width < 1 or self.height < 1:
            raise OptionError(f"image size must be positive, not {self.width} x {self.height}")
        if not self.near > 0 and not self.orthographic:
            raise OptionError(f"near must be positive, not {self.near}")

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Where the camera stands in the world, metres."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def to_camera(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points in camera space."""
        return points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points as (pixel x, pixel y, depth in metres)."""
        camera = self.to_camera(points)
        homogeneous = camera.copy()
        if self.orthographic:
            homogeneous[..., 2] = 1.0
        image = homogeneous @ self.intrinsics.T
        return np.concatenate([image[..., :2] / homogeneous[..., 2:], camera[..., 2:]], axis=-1)

    def scaled(self, factor: float) -> "Camera":
        """The same view with `factor` times as many pixels a side."""
        intrinsics = np.diag([factor, factor, 1.0]) @ self.intrinsics
        width, height = round(self.width * factor), round(self.height * factor)
        return Camera(self.world_to_camera, intrinsics, width, height, self.near, self.orthographic)


def look_at(eye: Point, target: Point, up: Point = (0.0, 1.0, 0.0)) -> Float[np.ndarray, "4 4"]:
    """World-to-camera matrix of a camera at `eye` that looks at `target` with `up` upwards in the image.

    Raises
    ------
    OptionError
        If `eye` is `target`, or `up` is parallel to the viewing direction.
    """
    eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    forward = target - eye
    right = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(forward) < 1e-12 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
        raise OptionError(
            f"cannot look from {eye.tolist()} at {target.tolist()} with up {np.asarray(up).tolist()}"
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = right, np.cross(forward, right), forward
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix


def _pinhole(fov: float, width: int, height: int) -> np.ndarray:
    focal = 0.5 * min(width, height) / np.tan(fov / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def portrait_camera(
    vertices: Float[np.ndarray, "vertices 3"],
    width: int = 512,
    height: int = 512,
    azimuth: float = 0.0,
    elevation: float = 0.0,
    fov: float = np.radians(26.0),
    margin: float = 0.04,
) -> Camera:
    """A camera that frames a head.

    Parameters
    ----------
    vertices : (V, 3) float
        The head, metres, face along +z; usually its rest vertices, so that the camera stands still.
    azimuth, elevation : float
        Radians; positive azimuth moves the camera towards +x (the subject's left), positive elevation up.
    fov : float
        Angle of view over the shorter side, radians.
    margin : float
        Part of the shorter side left free on each side of the bounding box.
    """
    vertices = np.asarray(vertices, np.float64)
    low, high = vertices.min(0), vertices.max(0)
    target = (low + high) / 2
    direction = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    # The distance at which every vertex is inside the picture, found on the turned points themselves.
    turned = (vertices - target) @ look_at(direction, np.zeros(3))[:3, :3].T
    half = np.tan(fov / 2) * np.array([width, height]) / min(width, height) * (1 - 2 * margin)
    distance = float((np.abs(turned[:, :2]) / half - turned[:, 2:]).max())
    world_to_camera = look_at(target + distance * direction, target)
    return Camera(world_to_camera, _pinhole(fov, width, height), width, height, near=min(0.01, distance / 10))


def orthographic_camera(
    vertices: Float[np.ndarray, "vertices 3"],
    direction: Point,
    pixel: float,
    margin: int = 4,
) -> Camera:
    """A parallel projection of all `vertices` seen from `direction`, at `pixel` metres a pixel."""
    direction = np.asarray(direction, np.float64)
    up = (0.0, 1.0, 0.0) if abs(direction[1]) < 0.99 * np.linalg.norm(direction) else (0.0, 0.0, 1.0)
    matrix = look_at(direction, np.zeros(3), up)
    turned = matrix[:3, :3].astype(np.float32) @ np.asarray(vertices, np.float32).T
    low, high = turned.min(1).astype(float), turned.max(1).astype(float)
    matrix[:3, 3] = -low + np.array([margin, margin, margin]) * pixel
    size = np.ceil((high - low)[:2] / pixel).astype(int) + 2 * margin
    scale = np.diag([1 / pixel, 1 / pixel, 1.0])
    return Camera(matrix, scale, int(size[0]), int(size[1]), near=0.0, orthographic=True)
