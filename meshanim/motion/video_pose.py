"""Head pose from video: face landmarks in every picture, then the rigid motion that explains them.

Landmarks come from MediaPipe's face mesh (extra `video-pose`) or from any detector by file; the pose is the
perspective-n-point solution on the rigid landmarks of the default head.
"""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from importlib.resources import files
from pathlib import Path

import av
import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from meshanim.errors import DependencyError, FileFormatError, OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.motion.pose_track import PoseTrack, bridge_rotations

__all__ = [
    "FaceLandmarker",
    "landmark_geometry",
    "pose_from_landmarks",
    "pose_from_video",
    "read_video",
]

# The rigid ones of the 68 landmarks of iBUG (eye corners, bridge and wings of the nose) and the points of
# MediaPipe's face mesh in the same places.
IBUG = {
    27: 168,
    28: 6,
    29: 197,
    30: 4,
    31: 98,
    32: 97,
    33: 2,
    34: 326,
    35: 327,
    36: 33,
    39: 133,
    42: 362,
    45: 263,
}
FOCAL = 1.5
"""Focal length of an unknown camera over the longer side of its picture."""
FEWEST = 6
LOOSEST = 0.006
"""Metres: landmarks that move further are left out."""
LARGEST_GAP = 0.5
"""Seconds without a face that are bridged."""


class FaceLandmarker:
    """MediaPipe's face mesh: 478 landmarks of the one face in a picture.

    A context manager; the detector tracks from picture to picture where `tracking` is set.

    Raises
    ------
    DependencyError
        If mediapipe is not installed.
    """

    def __init__(self, tracking: bool = False):
        try:
            from mediapipe.python.solutions.face_mesh import FaceMesh
        except ImportError as error:
            raise DependencyError("mediapipe 0.10.14 (Python up to 3.12)", "video-pose") from error
        self._mesh = FaceMesh(static_image_mode=not tracking, refine_landmarks=True, max_num_faces=1)

    def __enter__(self) -> "FaceLandmarker":
        return self

    def __exit__(self, *_) -> None:
        self._mesh.close()

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "landmarks 2"] | None:
        """Landmarks in pixels (x, y), pixel centres at half integers; None where there is no face."""
        found = self._mesh.process(np.ascontiguousarray(image)).multi_face_landmarks
        if not found:
            return None
        height, width = image.shape[:2]
        return np.array([(point.x * width, point.y * height) for point in found[0].landmark])


def landmark_geometry(
    layout: str = "mediapipe",
) -> tuple[Float[np.ndarray, "landmarks 3"], Float[np.ndarray, " landmarks"]]:
    """Landmarks on the default head at rest, and how far speech and detectors move them off, in metres.

    Parameters
    ----------
    layout : {"mediapipe", "ibug68"}
        478 points of MediaPipe's face mesh, or the 68 of iBUG, of which most are NaN: not to use.
    """
    head = load_head("default")
    source = files("meshanim.heads.default").joinpath("landmarks.npz")
    with source.open("rb") as file, np.load(file) as archive:
        corners = head.mesh.vertices[head.mesh.faces[archive["face"]]]
        points = (corners * archive["barycentric"][..., None]).sum(1)
        tolerance = archive["tolerance"].astype(np.float64)
    if layout == "mediapipe":
        points[tolerance > LOOSEST] = np.nan
        return points, tolerance
    if layout != "ibug68":
        raise OptionError(f"landmarks are mediapipe or ibug68, not {layout}")
    few, loose = np.full((68, 3), np.nan), np.ones(68)
    few[list(IBUG)], loose[list(IBUG)] = points[list(IBUG.values())], tolerance[list(IBUG.values())]
    return few, loose


def pose_from_landmarks(
    landmarks: Float[np.ndarray, "frames landmarks 2"],
    width: int,
    height: int,
    focal: float | None = None,
    points: Float[np.ndarray, "landmarks 3"] | None = None,
) -> Float[np.ndarray, "frames 3"]:
    """Head rotation in every picture, by perspective-n-point with a robust loss.

    Parameters
    ----------
    landmarks : (T, L, 2)
        Pixels, pixel centres at half integers; NaN for landmarks or whole frames that were not found. L is
        478 or 468 (MediaPipe) or 68 (iBUG) unless `points` are given.
    width, height : int
        Of the pictures; the camera looks through their middle.
    focal : float, optional
        Pixels; 1.5 times the longer side if not given.
    points : (L, 3), optional
        The same landmarks on the resting head, metres; NaN for those not to use.

    Returns
    -------
    (T, 3)
        Axis-angle, radians, zero where the face looks straight at the camera; NaN where fewer than six
        landmarks were found.

    Raises
    ------
    ShapeError
        If the number of landmarks is none of these.
    """
    if points is None:
        layout = {478: "mediapipe", 468: "mediapipe", 68: "ibug68"}.get(landmarks.shape[1])
        if layout is None:
            raise ShapeError(
                f"{landmarks.shape[1]} landmarks: expected 478 or 468 (MediaPipe), 68 (iBUG), or own points"
            )
        points, tolerance = (array[: landmarks.shape[1]] for array in landmark_geometry(layout))
    else:
        tolerance = np.full(len(points), 0.003)
    if points.shape != (landmarks.shape[1], 3):
        raise ShapeError(f"points must be ({landmarks.shape[1]}, 3) as the landmarks are, not {points.shape}")
    if focal is None:
        focal = FOCAL * max(width, height)
    # Image rays of a camera that sees the resting head upright: x right, y up, the head along -z.
    rays = (landmarks - np.array([width, height]) / 2) / focal * np.array([1.0, -1.0])
    usable = np.isfinite(points).all(1)
    anchor = points[usable].mean(0)
    result = np.full((len(landmarks), 3), np.nan)
    last: np.ndarray | None = None
    for frame, ray in enumerate(rays):
        seen = usable & np.isfinite(ray).all(1)
        if seen.sum() < FEWEST:
            last = None
            continue
        last = _solve(points[seen] - anchor, ray[seen], tolerance[seen], last)
        result[frame] = last[:3]
    return result


def _solve(
    points: np.ndarray, rays: np.ndarray, tolerance: np.ndarray, start: np.ndarray | None
) -> np.ndarray:
    """Rotation vector and the head's place (x / depth, y / depth, log depth) that explain the rays."""
    if start is None:
        start = _weak_perspective(points, rays)

    def residual(pose: np.ndarray) -> np.ndarray:
        turned = points @ Rotation.from_rotvec(pose[:3]).as_matrix().T
        depth = np.exp(pose[5])
        image = (turned[:, :2] + pose[3:5] * depth) / (depth - turned[:, 2:])
        return ((image - rays) * weights).ravel()

    # First all landmarks have a say, then those far off lose theirs.
    weights = np.exp(start[5]) / tolerance[:, None]
    for loss in ("soft_l1", "cauchy"):
        start = least_squares(residual, start, loss=loss, x_scale="jac", max_nfev=50).x
    return start


def _weak_perspective(points: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Start: the orthographic solution by linear least squares, made a rotation."""
    middle = rays.mean(0)
    rows = np.linalg.lstsq(points - points.mean(0), rays - middle, rcond=None)[0].T
    scale = np.linalg.norm(rows, axis=1).mean()
    first, second = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    u, _, v = np.linalg.svd(np.stack([first, second, np.cross(first, second)]))
    matrix = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    depth = np.log(1 / max(scale, 1e-6))
    return np.concatenate([Rotation.from_matrix(matrix).as_rotvec(), middle, [depth]])


def read_video(path: str | Path) -> tuple[float, Iterator[UInt8[np.ndarray, "height width 3"]]]:
    """Frames a second and the pictures of a video, in order.

    Raises
    ------
    FileFormatError
        If the file is no video.
    """
    try:
        with av.open(str(path)) as file:
            if not file.streams.video:
                raise FileFormatError(f"{path} has no pictures")
            rate = file.streams.video[0].average_rate or Fraction(25)
    except (av.FFmpegError, OSError) as error:
        raise FileFormatError(f"cannot read {path} as video: {error}") from error

    def pictures() -> Iterator[np.ndarray]:
        with av.open(str(path)) as file:
            for frame in file.decode(video=0):
                yield frame.to_ndarray(format="rgb24")

    return float(rate), pictures()


def pose_from_video(path: str | Path, focal: float | None = None) -> PoseTrack:
    """Track the one head in a video (GAVA, Sec. III-B, stage two).

    Parameters
    ----------
    path : path
        Anything FFmpeg decodes.
    focal : float, optional
        Pixels; 1.5 times the longer side if not given. A wrong one mostly rescales the depth.

    Raises
    ------
    FileFormatError
        If the file is no video, or half a second and more of it shows no face.
    DependencyError
        If mediapipe is not installed.
    """
    fps, pictures = read_video(path)
    found, size = _landmarks(pictures)
    if size is None:
        raise FileFormatError(f"{path} has no pictures")
    poses = pose_from_landmarks(found, size[1], size[0], focal)
    try:
        return PoseTrack(bridge_rotations(poses, int(LARGEST_GAP * fps)), fps)
    except OptionError as error:
        raise FileFormatError(f"{path}: no face found in part of the video ({error})") from error


def _landmarks(pictures: Iterable[np.ndarray]) -> tuple[np.ndarray, tuple[int, int] | None]:
    rows: list[np.ndarray] = []
    size: tuple[int, int] | None = None
    with FaceLandmarker(tracking=True) as find:
        for picture in pictures:
            size = picture.shape[:2]
            landmarks = find(picture)
            rows.append(np.full((478, 2), np.nan) if landmarks is None else landmarks)
    return np.stack(rows) if rows else np.zeros((0, 478, 2)), size
