"""The calibration of Multiface: its file KRT, and the head pose of a frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from meshanim.errors import FileFormatError

__all__ = ["CalibratedCamera", "read_head_pose", "read_krt"]

MILLIMETRE = 0.001
# A block of KRT without its name: 3 rows of intrinsics, 1 of distortion, 3 of [R|t].
ROWS = 7


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera of a capture, in OpenCV axes (x right, y down, z forward).

    Parameters
    ----------
    name : str
        As in the files, "400002".
    world_to_camera : (4, 4) float64
        Rigid, metres.
    intrinsics : (3, 3) float64
        Pixels, pixel centres at half integers.
    distortion : (D,) float64
        OpenCV's coefficients; zeros where the images are undistorted.
    width, height : int
        Image size in pixels.
    """

    name: str
    world_to_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " coefficients"]
    width: int
    height: int

    def head_to_camera(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "4 4"]:
        """From vertices of a tracked mesh to the camera, by the head pose of that frame, metres."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, translation
        return self.world_to_camera @ pose


def read_krt(path: str | Path, width: int = 1334, height: int = 2048) -> dict[str, CalibratedCamera]:
    """Read the cameras of an entity from its file KRT.

    Parameters
    ----------
    path : str or Path
        The file: blocks of a name, three rows of intrinsics, one of distortion and three of [R|t] in
        millimetres, an empty line between them.
    width, height : int
        Size of the images in pixels; the file does not have it. The default is that of the release.

    Returns
    -------
    dict of CalibratedCamera
        By name, in the order of the file.

    Raises
    ------
    FileFormatError
        If the file is missing, cut short, or a matrix is none of a camera.
    """
    path = Path(path)
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error
    lines = [line for line in lines if line]
    if not lines or len(lines) % (1 + ROWS):
        raise FileFormatError(
            f"{path} has {len(lines)} lines; expected {1 + ROWS} a camera: name, K, distortion, [R|t]"
        )
    cameras = {}
    for start in range(0, len(lines), 1 + ROWS):
        name, *rows = lines[start : start + 1 + ROWS]
        if name in cameras:
            raise FileFormatError(f"{path} has camera {name} twice")
        cameras[name] = _camera(path, name, rows, width, height)
    return cameras


def _camera(path: Path, name: str, rows: list[str], width: int, height: int) -> CalibratedCamera:
    try:
        numbers = [np.array(row.split(), np.float64) for row in rows]
        intrinsics, distortion, extrinsics = np.stack(numbers[:3]), numbers[3], np.stack(numbers[4:])
    except ValueError as error:
        raise FileFormatError(f"{path}: camera {name}: {error}") from error
    if intrinsics.shape != (3, 3) or extrinsics.shape != (3, 4):
        raise FileFormatError(
            f"{path}: camera {name} has intrinsics {intrinsics.shape} and [R|t] {extrinsics.shape}, "
            "expected (3, 3) and (3, 4)"
        )
    if not all(np.isfinite(array).all() for array in (intrinsics, distortion, extrinsics)):
        raise FileFormatError(f"{path}: camera {name} has numbers that are not finite")
    if not (intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0 and np.allclose(intrinsics[2], (0, 0, 1))):
        raise FileFormatError(f"{path}: camera {name} has no intrinsics: {intrinsics.tolist()}")
    world_to_camera = np.eye(4)
    world_to_camera[:3] = extrinsics
    world_to_camera[:3, 3] *= MILLIMETRE
    if not is_rotation(world_to_camera[:3, :3]):
        raise FileFormatError(f"{path}: camera {name}: R of [R|t] is no rotation")
    return CalibratedCamera(name, world_to_camera, intrinsics, distortion, width, height)


def read_head_pose(
    path: str | Path,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Read FRAME_transform.txt: where the tracked mesh of a frame is in the world of the cameras.

    Returns
    -------
    rotation : (3, 3) float64
    translation : (3,) float64
        Metres: a vertex x of the mesh is at `rotation @ x + translation`.

    Raises
    ------
    FileFormatError
        If the file is missing or no rigid 3 x 4 transform.
    """
    path = Path(path)
    try:
        numbers = np.array(path.read_text(encoding="utf-8").split(), np.float64)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise FileFormatError(f"{path} is no table of numbers: {error}") from error
    if numbers.shape != (12,):
        raise FileFormatError(f"{path} has {len(numbers)} numbers, expected 3 rows of 4")
    transform = numbers.reshape(3, 4)
    if not np.isfinite(transform).all() or not is_rotation(transform[:, :3]):
        raise FileFormatError(f"{path} is no rotation and translation")
    return transform[:, :3], transform[:, 3] * MILLIMETRE


def is_rotation(matrix: Float[np.ndarray, "3 3"]) -> bool:
    """Whether a matrix read from decimal text is a rotation, to a thousandth."""
    return bool(np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) and np.linalg.det(matrix) > 0)
