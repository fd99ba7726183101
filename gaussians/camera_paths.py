"""Where the camera is in each frame of a video."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from meshanim.errors import FileFormatError, MeshanimError, OptionError
from meshanim.files import read_json
from meshanim.gaussians.cameras import Cameras
from meshanim.render.camera import Camera, look_at, portrait_camera

__all__ = ["CAMERAS", "camera_path", "read_camera_path", "still_camera"]

CAMERAS = ("front", "orbit")
SWING, NOD, PERIOD = np.radians(40.0), np.radians(8.0), 8.0
"""Of the orbit: radians to each side, radians up and down, seconds until it is back."""


def camera_path(
    name: str, head: Float[np.ndarray, "vertices 3"], frames: int, fps: float, width: int, height: int
) -> Cameras:
    """Cameras of all frames, (T, 1, 4, 4), that frame a head.

    Parameters
    ----------
    name : str
        "front": stands still before the face. "orbit": swings 40 degrees to each side and 8 up and down, in
        8 seconds, at one distance.
    head : (V, 3) float
        Vertices at rest, metres, the face along +z.
    frames : int
        How many.
    fps : float
        Frames a second.
    width, height : int
        Pixels.

    Raises
    ------
    OptionError
        If there is no camera of that name.
    """
    if name not in CAMERAS:
        raise OptionError(f"camera must be {', '.join(CAMERAS)} or a .json file, not {name!r}")
    if name == "front":
        return still_camera(portrait_camera(head, width, height), frames)
    phase = 2 * np.pi * np.arange(frames) / (PERIOD * fps)
    angles = np.stack([SWING * np.sin(phase), NOD * np.sin(2 * phase)], 1)
    views = [portrait_camera(head, width, height, azimuth, elevation) for azimuth, elevation in angles]
    target = (head.min(0) + head.max(0)) / 2
    offsets = np.array([view.position - target for view in views])
    farthest = np.linalg.norm(offsets, axis=1).max()
    offsets *= farthest / np.linalg.norm(offsets, axis=1, keepdims=True)
    path = [
        Camera(look_at(target + offset, target), views[0].intrinsics, width, height) for offset in offsets
    ]
    together = Cameras.of(path)
    return _one_a_frame(together)


def read_camera_path(path: str | Path, frames: int) -> Cameras:
    """Cameras of all frames, (T, 1, 4, 4), from a file in the layout of a capture's cameras.json.

    {"cameras": {NAME: {"world_to_camera": 4 x 4, "intrinsics": 3 x 3, "width": W, "height": H}, ...}},
    OpenCV, metres and pixels: one for all frames, or one a frame in the file's order. `FILE.json:NAME` takes
    the camera of that name for all frames.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged, of another layout, or its number of cameras does not fit.
    """
    path, _, name = str(path).partition(".json:")
    path = path if path.endswith(".json") else path + ".json"
    content = read_json(path)
    try:
        listed = content["cameras"]
        chosen = [listed[name]] if name else list(listed.values())
        cameras = [
            Camera(
                np.array(entry["world_to_camera"], np.float64),
                np.array(entry["intrinsics"], np.float64),
                int(entry["width"]),
                int(entry["height"]),
            )
            for entry in chosen
        ]
        together = Cameras.of(cameras)
    except KeyError as error:
        raise FileFormatError(f"{path} has no {error}") from error
    except (ValueError, TypeError, AttributeError, MeshanimError) as error:
        raise FileFormatError(f"{path} holds no cameras: {error}") from error
    if len(cameras) == 1:
        return still_camera(cameras[0], frames)
    if len(cameras) != frames:
        raise FileFormatError(
            f"{path} has {len(cameras)} cameras for {frames} frames: one or as many are needed; "
            f"choose one by {path}:NAME"
        )
    return _one_a_frame(together)


def still_camera(camera: Camera, frames: int) -> Cameras:
    """One camera for so many frames, (T, 1, 4, 4)."""
    seen = Cameras.of(camera)
    pose, intrinsics = seen.world_to_camera, seen.intrinsics
    return Cameras(
        pose.expand(frames, *pose.shape),
        intrinsics.expand(frames, *intrinsics.shape),
        camera.width,
        camera.height,
    )


def _one_a_frame(path: Cameras) -> Cameras:
    return Cameras(path.world_to_camera[:, None], path.intrinsics[:, None], path.width, path.height)
